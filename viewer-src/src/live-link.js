// The connection to the simulation: asks for one frame after the other, sends commands, and comes back after an interruption.
import { decodeFrame } from "./live-decode.js";

const FINAL = new Set([1007, 1008]); // malformed or not allowed: trying again would not help
const REPLACED = 1013;

export class LiveLink {
  /**
   * @param {string} token secret part of the address
   * @param {{onFrame: Function, onTrouble: Function, onState: Function}} listener
   */
  constructor(token, listener) {
    this.address = `${window.location.protocol === "https:" ? "wss" : "ws"}://${window.location.host}/session?token=${encodeURIComponent(token)}`;
    this.listener = listener;
    this.delay = 500;
    this.arrivals = [];
    this.newest = null; // frame that waits to be drawn
    this.owed = false; // whether the next frame is asked for only when that is drawn
    this.connect();
  }

  connect() {
    this.socket = new WebSocket(this.address);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => {
      this.delay = 500;
      this.listener.onState("connected");
      this.owed = false;
      this.send({ type: "next" });
    };
    this.socket.onmessage = ({ data }) => {
      if (typeof data === "string") this.listener.onTrouble(JSON.parse(data).trouble);
      else this.#received(decodeFrame(data));
    };
    this.socket.onclose = ({ code, reason }) => {
      if (FINAL.has(code)) this.listener.onState("refused", reason || "the server refused this page; open the address that naibu live printed");
      else {
        this.listener.onState("lost", code === REPLACED ? "too many pages are open" : "the simulation does not answer; trying again");
        this.timer = setTimeout(() => this.connect(), this.delay);
        this.delay = Math.min(2 * this.delay, 5000);
      }
    };
  }

  /** Keep the newest frame for the next picture; while it waits to be drawn, one more is on its way, and no further one is asked for. */
  #received(frame) {
    const now = performance.now();
    this.arrivals = [...this.arrivals.filter((t) => now - t < 1000), now];
    const waits = this.newest !== null;
    this.newest = frame;
    if (waits) {
      this.owed = true;
      return;
    }
    this.send({ type: "next" });
    requestAnimationFrame(() => this.#draw());
  }

  #draw() {
    const frame = this.newest;
    this.newest = null;
    if (this.owed) this.send({ type: "next" });
    this.owed = false;
    this.listener.onFrame(frame);
  }

  /** Frames received in the last second. */
  get framesPerSecond() {
    return this.arrivals.length;
  }

  send(command) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(command));
  }
}
