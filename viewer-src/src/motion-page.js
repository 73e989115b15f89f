// The page of a simulated motion: adds the 3-D view and its controls to #naibu-motion, and moves the time marker of the force curves.
import { tableGradient } from "./colormap.js";
import { decodeMotion } from "./decode.js";
import { canDrawOr, h } from "./elements.js";
import { MotionView } from "./motion.js";
import { VIEWS } from "./view.js";

const SPEEDS = [0.05, 0.1, 0.25, 0.5, 1, 2, 5, 10, 50];
const LONGEST_S = 12;

const digits = (value) => String(Number(value.toPrecision(3))).replace("-", "−");

class MotionPage {
  constructor(root, data) {
    this.data = data;
    this.mark = document.getElementById("naibu-now");
    this.#build(root);
    this.view = new MotionView(this.stage);
    this.view.listenToKeys({ " ": () => this.toggle() });
    this.view.show(data);
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.view.applyTheme());
    this.colourBy(0);
    this.setTime(this.#mostMoved());
    this.stage.setAttribute("data-ready", "1");
  }

  get duration() {
    return this.data.times[this.data.times.length - 1];
  }

  /** Time of the largest displacement, which the page shows first. */
  #mostMoved() {
    const { displacement, frames, reference, times } = this.data;
    let [best, most] = [0, -1];
    for (let f = 0; f < frames; f += 1) {
      let largest = 0;
      for (let k = f * reference.length; k < (f + 1) * reference.length; k += 1) largest = Math.max(largest, Math.abs(displacement[k]));
      if (largest > most) [best, most] = [f, largest];
    }
    return times[best];
  }

  #build(root) {
    this.stage = h("div", { class: "stage", tabindex: 0, role: "application", "aria-label": "3-D view. Arrow keys rotate, plus and minus zoom, R resets, space plays." });
    this.choice = h("select", { id: "naibu-field", onchange: () => this.colourBy(Number(this.choice.value)) },
      ...this.data.fields.map((field, i) => h("option", { value: i }, field.name)));
    const views = h("div", { class: "buttons", role: "group", "aria-label": "View from" },
      ...Object.entries(VIEWS).filter(([key]) => key !== "oblique").map(([key, { label }]) => h("button", { type: "button", onclick: () => this.view.look(key) }, label)),
      h("button", { type: "button", onclick: () => this.view.look("oblique") }, "Reset view"));
    this.gradient = h("div", { class: "gradient" });
    this.ticks = h("div", { class: "ticks" });
    const toggle = (what, text) => {
      const box = h("input", { type: "checkbox", checked: true, onchange: () => this.view.setVisible(what, box.checked) });
      return h("label", { class: "toggle" }, box, text);
    };
    root.replaceChildren(
      h("div", { class: "bar" }, views),
      this.stage,
      this.#timeControls(),
      h("div", { class: "load shown" }, toggle("mesh", "mesh"), ...(this.data.bodies.length ? [toggle("bodies", "indenters")] : []), toggle("reference", "undeformed outline")),
      h("div", { class: "bar" }, h("label", { for: "naibu-field" }, "Colour by"), this.choice),
      h("div", { class: "motion-scale" }, this.gradient, this.ticks),
      h("p", { class: "hint" }, "Drag to rotate, right-drag or drag with two fingers to pan. Click the view, then scroll to zoom."));
  }

  #timeControls() {
    this.clock = this.data.clock ?? ["time", "s"];
    this.slider = h("input", { type: "range", id: "naibu-time", min: 0, max: this.duration, step: this.duration / 1000 || 1, "aria-label": this.clock[0],
      oninput: () => { this.stop(); this.setTime(Number(this.slider.value)); } });
    this.play = h("button", { type: "button", class: "play", onclick: () => this.toggle() }, "▶ Play");
    this.label = h("output", { for: "naibu-time", class: "timelabel" });
    const usual = SPEEDS.find((s) => this.duration / s <= LONGEST_S) ?? SPEEDS[SPEEDS.length - 1];
    this.speed = h("select", { id: "naibu-speed", "aria-label": "Speed", onchange: () => { if (this.timer) { this.stop(); this.start(); } } },
      ...SPEEDS.map((s) => h("option", { value: s, selected: s === (this.duration >= 2 ? Math.max(usual, 1) : usual) }, s !== 1 ? `${s}×` : this.clock[1] === "s" ? "real time" : `1 ${this.clock[1]}/s`)));
    return h("div", { class: "load" }, this.play, h("div", { class: "slide" }, this.slider, this.label), this.speed);
  }

  colourBy(index) {
    const field = this.data.fields[index];
    this.view.colourBy(index);
    this.gradient.style.background = tableGradient(field.diverging);
    this.ticks.replaceChildren(...[0, 1, 2, 3, 4].map((k) => h("span", {}, digits(field.low + (k / 4) * (field.high - field.low)))));
  }

  setTime(time) {
    const { times } = this.data;
    this.time = Math.min(this.duration, Math.max(0, time));
    let i = 0;
    while (i < times.length - 2 && times[i + 1] <= this.time) i += 1;
    const span = times.length > 1 ? times[i + 1] - times[i] : 1;
    this.view.setFrame(i + (this.time - times[i]) / span);
    this.slider.value = this.time;
    this.label.value = `${this.time.toFixed(this.duration < 10 ? 2 : 1)} ${this.clock[1]}`;
    if (this.mark) {
      const { from, to } = this.mark.dataset;
      const x = Number(from) + (Number(to) - Number(from)) * (this.duration ? this.time / this.duration : 0);
      this.mark.setAttribute("transform", `translate(${x.toFixed(2)} 0)`);
    }
  }

  toggle() {
    if (this.timer) this.stop();
    else this.start();
  }

  start() {
    const from = this.time >= this.duration ? 0 : this.time;
    const began = performance.now();
    this.play.textContent = "❚❚ Pause";
    const tick = (now) => {
      this.setTime(from + (Number(this.speed.value) * Math.max(0, now - began)) / 1000);
      if (this.time >= this.duration) this.stop();
      else this.timer = requestAnimationFrame(tick);
    };
    this.timer = requestAnimationFrame(tick);
  }

  stop() {
    cancelAnimationFrame(this.timer ?? 0);
    this.timer = null;
    this.play.textContent = "▶ Play";
  }
}

async function begin() {
  const root = document.getElementById("naibu-motion");
  const data = document.getElementById("naibu-frames");
  if (!root || !data || !canDrawOr(root)) return;
  window.naibuMotion = new MotionPage(root, await decodeMotion(JSON.parse(data.textContent)));
}

begin();
