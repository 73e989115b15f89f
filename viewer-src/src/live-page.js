// The live page: builds view and controls in #naibu-live, and leads the tools by mouse, touch, keyboard and gamepad.
import { Vector3 } from "three";
import { tableGradient } from "./colormap.js";
import { CutNotice } from "./cut-notice.js";
import { canDrawOr, h } from "./elements.js";
import { decodeScene } from "./live-decode.js";
import { LiveLink } from "./live-link.js";
import { LiveView } from "./live-view.js";
import { ReadingPlots } from "./reading-plots.js";
import { TimeCurve } from "./time-curve.js";

const MODES = { push: "Push", pull: "Pull", cut: "Cut", probe: "Probe" };
const STROKE_PX = 6; // between two positions of the blade
const CLOSED_PX = 15; // between the ends of a path that is meant to be closed
const CLOSED_FROM = 8; // positions
const HINTS = {
  push: "Drag the tool, or use the keys W A S D (up, left, down, right) and Q E (away, towards). Z X, C V, F G or Alt and the wheel turn it. Drag elsewhere to rotate.",
  pull: "Drag a point of the surface; it is released when you let go. Drag elsewhere to rotate.",
  cut: "Draw a line across the object: the blade cuts through it, away from you. Begin beside it to cut in from its rim; a line that ends where it began cuts a piece out.",
  probe: "Click a point of the surface to follow its displacement.",
};
const TOUCH_HINTS = {
  push: "Drag the tool with a finger. Drag elsewhere to rotate; two fingers zoom.",
  pull: "Drag a point of the surface; it is released when you let go. Drag elsewhere to rotate; two fingers zoom.",
  cut: HINTS.cut,
  probe: "Tap a point of the surface to follow its displacement.",
};
const AXES = ["x", "y", "z"];
const DEAD_ZONE = 0.15;
const TURN = 0.1; // rad, of a key
const STEP = 0.02; // of the object's size, of a key
const REPEAT_MS = 250; // after which a key that is held moves the tool on
const SPEED = 0.3; // of the object's size a second, of such a key
const LEASH = 0.25; // of the object's size, by which keys and sticks lead the tool at most
const PAD_SPEED = 0.6; // of the object's size a second, of a stick that is held
const PAD_TURN = 1.8; // rad a second, of such a stick
const WHEEL_TURN = 0.001; // rad, of a pixel
const WRITE_MS = 100; // from one reading of the numbers to the next
const CURVE_MS = 50; // from one drawing of the curves to the next
const UNBALANCED = 0.05; // of all forces, above which the badge says so
const digits = (value) => String(Number(value.toPrecision(3))).replace("-", "−");
const CONFLICTS = new Set(["cut", "tool", "grip", "undo", "reset"]); // with a cut under way: another body comes of it, or none
const WAIT = "A cut is being computed: wait until it opens.";
const ANEW = new Set([...CONFLICTS, "pause", "record", "replay"]); // what was wrong with an earlier command is no longer told then
/** Gamepads that are connected; none where the page may not ask for them, as within a frame of another site. */
const gamepads = () => {
  try {
    return [...(navigator.getGamepads?.() ?? [])];
  } catch {
    return [];
  }
};
const newtons = (force) => Math.hypot(...force) / 1000;

class LivePage {
  constructor(root, scene, token) {
    this.scene = scene;
    this.mode = "push";
    this.probed = -1;
    this.held = new Map(); // keys that lead the tool
    this.touched = window.matchMedia("(pointer: coarse)"); // a screen that fingers touch, without keys
    this.written = this.curved = -Infinity; // times at which numbers were written and curves drawn, ms
    this.tool = scene.tools.length ? scene.tools[0].name : "";
    this.#build(root);
    this.view = new LiveView(this.stage);
    this.stage.append(this.readout, this.notice.element);
    this.view.show(scene);
    this.view.listenToKeys(this.#keys());
    this.curve = new TimeCurve(this.canvas, "force (N)");
    this.#listen();
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.view.applyTheme());
    this.setMode("push");
    this.link = new LiveLink(token, {
      onFrame: (frame) => this.#show(frame),
      onTrouble: (text) => this.#refused(text),
      onState: (state, text) => this.#connected(state, text),
    });
  }

  #button(text, action, attributes = {}) {
    return h("button", { type: "button", onclick: action, ...attributes }, text);
  }

  #build(root) {
    this.stage = h("div", { class: "stage", tabindex: 0, role: "application", "aria-label": "3-D view of the simulation. Arrow keys rotate, plus and minus zoom, W A S D Q E move the tool, Z X, C V and F G turn it." });
    this.modes = Object.entries(MODES).filter(([mode]) => mode !== "cut" || this.scene.cuttable).map(([mode, text]) => this.#button(text, () => this.setMode(mode), { "data-mode": mode, "aria-pressed": "false" }));
    this.toolChoice = h("select", { id: "naibu-tool", onchange: () => this.take(this.toolChoice.value) },
      ...this.scene.tools.map((t) => h("option", { value: t.name }, t.name)), h("option", { value: "" }, "no tool"));
    this.pause = this.#button("❚❚ Pause", () => this.command("pause", { on: !this.frame?.paused }));
    this.record = this.#button("● Record", () => this.command("record", { on: !this.frame?.recording }));
    this.hint = h("p", { class: "hint" });
    this.gradient = h("div", { class: "gradient" });
    this.gradient.style.background = tableGradient(false);
    this.ticks = h("div", { class: "ticks" });
    this.colour = h("select", { id: "naibu-colour", onchange: () => this.command("colour", { name: this.colour.value }, true) },
      h("option", { value: "displacement" }, "displacement, mm"), h("option", { value: "strain" }, this.scene.strain));
    this.badge = h("p", { class: "badge", role: "status" }, "connecting");
    this.message = h("p", { class: "note trouble", role: "alert" });
    this.caution = h("p", { class: "note trouble", role: "status" }); // of the tool in play
    this.readout = h("p", { class: "readout", "aria-hidden": "true" }); // where the numbers are too far below to be seen
    this.canvas = h("canvas", { class: "time-curve", role: "img", "aria-label": "Force of the last ten seconds" });
    this.numbers = Object.fromEntries(["force", "indentation", "overlap", "pull", "time", "rate", "probe"].map((name) => [name, h("dd", {}, "–")]));
    this.plots = new ReadingPlots(this.scene.readings);
    this.notice = new CutNotice(this.scene.cut_stages);
    this.undo = this.#button("↺ Undo", () => this.back("undo"));
    this.reset = this.#button("Reset", () => this.back("reset"));
    this.conflicting = [...this.modes.filter((b) => ["cut", "pull"].includes(b.dataset.mode)), this.toolChoice, this.undo, this.reset];
    const labels = {
      force: "force of the tool", indentation: "indentation depth", overlap: "overlap with the tool", pull: "force of the pull",
      time: "simulated time", rate: "rate", probe: "probed point",
    };
    this.numbers.indentation.title = "how deep the tool lies, along its force, below where the surface is at rest; where the body has moved as a whole, its way is part of it";
    this.numbers.overlap.title = "how far nodes of the surface lie in the tool as the contact yields; not how deep the tool presses";
    const list = h("dl", { class: "numbers" }, ...Object.entries(labels).flatMap(([name, text]) => [h("dt", {}, text), this.numbers[name]]));
    root.replaceChildren(
      h("div", { class: "bar" }, h("div", { class: "modes", role: "group", "aria-label": "What dragging does" }, ...this.modes),
        h("span", { class: "pair" }, h("label", { for: "naibu-tool" }, "Tool"), this.toolChoice), this.pause, this.undo, this.reset,
        this.#button("Whole view", () => this.view.look("oblique"))),
      h("div", { class: "live-grid" },
        h("div", {}, this.stage, this.hint, h("div", { class: "motion-scale" }, this.gradient, this.ticks), this.#viewControls()),
        h("div", { class: "live-state" }, this.badge, this.message), // on the picture where what stands beside it is too far below
        h("div", { class: "live-side" }, this.caution, list, this.canvas,
          h("div", { class: "bar" }, this.record, this.#button("▶ Replay", () => this.command("replay")),
            this.#button("Save as a page", () => this.#save()),
            this.#button("Screenshot", () => this.#screenshot())))),
      ...(this.scene.readings.length ? [this.plots.element] : []));
  }

  #viewControls() {
    const slider = h("input", { type: "range", min: 0, max: 1, step: 0.01, value: 0.5, "aria-label": "Position of the section", disabled: true,
      oninput: () => this.view.setClip(Number(axis.value), Number(slider.value)) });
    const axis = h("select", { id: "naibu-clip", onchange: () => {
      slider.disabled = axis.value === "";
      this.view.setClip(axis.value === "" ? null : Number(axis.value), Number(slider.value));
    } }, h("option", { value: "" }, "none"), ...AXES.map((name, k) => h("option", { value: k }, `across ${name}`)));
    const toggle = (text, action) => {
      const box = h("input", { type: "checkbox", onchange: () => action(box.checked) });
      return h("label", { class: "toggle" }, box, text);
    };
    this.markers = toggle("markers", (on) => this.view.setMarkers(on));
    this.markers.hidden = !this.scene.markers.nodes.length;
    return h("div", { class: "bar" }, h("span", { class: "pair" }, h("label", { for: "naibu-clip" }, "Section"), axis), slider,
      h("span", { class: "pair" }, h("label", { for: "naibu-colour" }, "Colour by"), this.colour), toggle("mesh", (on) => this.view.setEdges(on)), this.markers);
  }

  #keys() {
    const moves = { w: ["up", 1], s: ["up", -1], d: ["right", 1], a: ["right", -1], q: ["away", 1], e: ["away", -1] };
    const keys = Object.fromEntries(Object.entries(moves).map(([key, [axis, sign]]) => [key, () => this.#press(key, axis, sign)]));
    const turns = { z: ["away", -1], x: ["away", 1], c: ["right", -1], v: ["right", 1], f: ["up", -1], g: ["up", 1] };
    Object.entries(turns).forEach(([key, [axis, sign]]) => { keys[key] = () => this.turn(axis, sign * TURN); });
    return { ...keys, " ": () => this.command("pause", { on: !this.frame?.paused }), u: () => this.back("undo") };
  }

  /** A key begins to lead the tool: by a step, and on while it is held; repetitions of the keyboard, which come in jerks, do not count. */
  #press(key, axis, sign) {
    if (this.held.has(key)) return;
    this.held.set(key, { axis, sign, since: performance.now() });
    this.nudge(axis, sign * STEP);
  }

  /** Lead the tool on by keys and sticks that are held, at a speed that does not depend on the keyboard nor on the rate of the frames. */
  #hold(now) {
    const seconds = Math.min(now - (this.moved ?? now), 100) / 1000;
    this.moved = now;
    this.#gamepad(seconds);
    for (const { axis, sign, since } of this.held.values()) if (now - since > REPEAT_MS) this.nudge(axis, sign * SPEED * seconds);
  }

  /** Send a command; those that steer are not sent by a page that only watches. */
  command(type, values = {}, always = false) {
    if (!this.frame?.driving && !always) this.#say("Another page drives this simulation; this one watches.");
    else if (this.notice.cutting && CONFLICTS.has(type)) this.#say(WAIT);
    else {
      if (ANEW.has(type)) this.#say("");
      this.link.send({ type, ...values });
      if (type === "cut") this.notice.ask();
    }
  }

  /** The server says what was wrong with a command. */
  #refused(text) {
    this.#say(text);
    this.notice.forget();
  }

  /** Undo or reset: keys lead the tool from where it is then. */
  back(type) {
    this.lead = null;
    this.command(type);
  }

  take(name) {
    this.tool = name;
    this.lead = null;
    this.toolChoice.value = name;
    this.command("tool", { name });
  }

  /** Another tool came into play, also by Undo: it is the one that is chosen, and keys lead it from where it is. */
  #inPlay(number) {
    this.tool = this.scene.tools[number]?.name ?? "";
    this.toolChoice.value = this.tool;
    this.lead = null;
  }

  setMode(mode) {
    this.mode = mode;
    this.modes.forEach((b) => b.setAttribute("aria-pressed", String(b.dataset.mode === mode)));
    this.hint.textContent = (this.touched.matches ? TOUCH_HINTS : HINTS)[mode];
  }

  /** Move the tool along an axis of the screen by a fraction of the object's size. */
  nudge(axis, fraction) {
    if (!this.frame || this.frame.tool < 0) return;
    const way = this.view.screenAxes()[axis];
    const size = 2 * this.view.extent.radius;
    const { centre } = this.frame;
    const ahead = (this.lead ?? centre).map((v, k) => v + fraction * size * way[k] - centre[k]);
    const share = Math.min(1, (LEASH * size) / Math.max(Math.hypot(...ahead), 1e-9)); // a tool that is held back comes back at once
    this.lead = centre.map((v, k) => v + share * ahead[k]);
    this.command("move", { at: this.lead });
  }

  /** Turn the tool about an axis of the screen by an angle, rad. */
  turn(axis, angle) {
    if (!this.frame || this.frame.tool < 0) return;
    this.command("turn", { by: this.view.screenAxes()[axis].map((v) => angle * v) });
  }

  #listen() {
    const { stage, view } = this;
    stage.addEventListener("keyup", (e) => this.held.delete(e.key.toLowerCase()));
    stage.addEventListener("blur", () => this.held.clear());
    stage.addEventListener("wheel", (e) => {
      if (!e.altKey) return;
      e.preventDefault();
      e.stopPropagation();
      this.turn("away", WHEEL_TURN * Math.max(-200, Math.min(200, e.deltaY)));
    }, { capture: true, passive: false });
    stage.addEventListener("pointerdown", (e) => {
      if (!this.frame || e.button !== 0) return;
      if (this.mode === "push" && (view.onTool(e.clientX, e.clientY) || e.shiftKey)) this.#drag(e, "move", this.frame.centre);
      else if (this.mode === "cut") this.#stroke(e);
      else if (this.mode !== "push") this.#touched(e);
    }, { capture: true });
  }

  #touched(e) {
    const hit = this.view.pick(e.clientX, e.clientY);
    if (!hit) return;
    if (this.mode === "probe") {
      this.probed = hit.node;
      this.#probe();
      this.#markProbed();
      return;
    }
    this.command("grip", { node: hit.node });
    this.#drag(e, "pull", hit.point.toArray());
  }

  /** Follow the pointer until it is released, then call `done`. */
  #followed(follow, done) {
    this.view.controls.enabled = false;
    const end = () => {
      this.view.controls.enabled = true;
      window.removeEventListener("pointermove", follow);
      ["pointerup", "pointercancel"].forEach((name) => window.removeEventListener(name, end));
      done();
    };
    window.addEventListener("pointermove", follow);
    ["pointerup", "pointercancel"].forEach((name) => window.addEventListener(name, end));
  }

  /** Draw the path of a blade, and cut when the pointer is released. */
  #stroke(e) {
    const path = [[e.clientX, e.clientY]];
    const box = this.stage.getBoundingClientRect();
    const follow = (event) => {
      const [x, y] = path[path.length - 1];
      if (Math.hypot(event.clientX - x, event.clientY - y) < STROKE_PX || path.length >= 199) return;
      path.push([event.clientX, event.clientY]);
      this.view.overlay.draw(path.map(([a, b]) => [a - box.left, b - box.top]));
    };
    this.#followed(follow, () => {
      this.view.overlay.draw([]);
      const [[x0, y0], [x1, y1]] = [path[0], path[path.length - 1]];
      if (path.length >= CLOSED_FROM && Math.hypot(x1 - x0, y1 - y0) < CLOSED_PX) path.push(path[0]);
      if (path.length > 1) this.command("cut", { edges: path.map(([x, y]) => this.view.edgeThrough(x, y)) });
    });
  }

  /** Lead the tool or the gripped point with the pointer, in the plane through `from` that faces the viewer. */
  #drag(e, kind, from) {
    const { view } = this;
    const start = view.inViewPlane(e.clientX, e.clientY, from);
    const follow = (event) => {
      const at = view.inViewPlane(event.clientX, event.clientY, from);
      if (!at || !start) return;
      const target = from.map((v, k) => v + at[k] - start[k]);
      if (kind === "move") this.lead = target;
      this.command(kind, { at: target });
    };
    this.#followed(follow, () => { if (kind === "pull") this.command("release"); });
  }

  #gamepad(seconds) {
    const pad = gamepads().find((one) => one?.axes);
    if (!pad) return;
    const axes = [["right", pad.axes[0]], ["up", -pad.axes[1]], ["away", -(pad.axes[3] ?? 0)]];
    axes.filter(([, value]) => Math.abs(value) > DEAD_ZONE).forEach(([axis, value]) => this.nudge(axis, PAD_SPEED * seconds * value));
    const held = (k) => Number(pad.buttons?.[k]?.pressed ?? false);
    const turns = [["away", pad.axes[2] ?? 0], ["right", held(5) - held(4)], ["up", held(7) - held(6)]];
    turns.filter(([, value]) => Math.abs(value) > DEAD_ZONE).forEach(([axis, value]) => this.turn(axis, PAD_TURN * seconds * value));
  }

  #show(frame) {
    if (frame.topology !== this.scene.topology) {
      this.notice.forget();
      this.#renew();
      return;
    }
    const first = !this.frame;
    if (first ? frame.tool >= 0 : frame.tool !== this.frame.tool) this.#inPlay(frame.tool);
    this.frame = frame;
    if (first && frame.driving && this.tool && frame.tool < 0) this.take(this.tool);
    this.view.setFrame(frame);
    this.#hold(performance.now());
    this.curve.add(frame.time, [[newtons(frame.gripped >= 0 ? frame.pull : frame.force), NaN, NaN]]);
    this.plots.add(frame.time, frame.readings);
    this.#markProbed();
    this.#badge(frame);
    this.notice.follow(frame, performance.now());
    this.notice.permit(frame, this.conflicting);
    if (!this.notice.cutting && this.message.textContent === WAIT) this.#say("");
    this.#write(frame, performance.now());
    this.stage.setAttribute("data-ready", "1");
  }

  /** Write numbers and draw curves, no more often than they can be read: laying out text takes longer than drawing the body. */
  #write(frame, now) {
    if (now - this.curved >= CURVE_MS) {
      this.curved = now;
      this.curve.draw();
      this.plots.draw();
    }
    if (now - this.written < WRITE_MS) return;
    this.written = now;
    const unit = frame.values ? this.scene.strain.split(", ").at(-1) : "mm";
    const { top, signed } = this.view;
    const scaled = `${top} ${signed} ${unit}`;
    if (this.scaled !== scaled) {
      const at = signed ? [-1, -0.5, 0, 0.5, 1] : [0, 0.25, 0.5, 0.75, 1];
      this.ticks.replaceChildren(...at.map((share, k) => h("span", {}, digits(share * top) + (k === 4 ? ` ${unit}` : ""))));
    }
    this.scaled = scaled;
    const { numbers } = this;
    numbers.force.textContent = frame.tool < 0 ? "–" : `${newtons(frame.force).toFixed(2)} N`;
    numbers.pull.textContent = frame.gripped < 0 ? "–" : `${newtons(frame.pull).toFixed(2)} N`;
    const shown = frame.gripped < 0 ? numbers.force.textContent : numbers.pull.textContent;
    this.readout.textContent = shown === "–" ? "" : shown;
    numbers.indentation.textContent = frame.tool < 0 || !newtons(frame.force) ? "–" : `${frame.indentation.toFixed(1)} mm`;
    numbers.overlap.textContent = frame.tool < 0 ? "–" : `${frame.penetration.toFixed(2)} mm`;
    numbers.time.textContent = `${frame.time.toFixed(2)} s`;
    numbers.rate.textContent = `${Math.round(frame.stepsPerSecond)} steps/s, ${this.link.framesPerSecond} frames/s`;
    this.plots.write();
    this.#probe();
  }

  /** Fetch the scene of a body that was cut, or whose cut was undone. */
  async #renew() {
    if (this.renewing) return;
    this.renewing = true;
    try {
      const answer = await fetch(`/scene${window.location.search}`);
      this.scene = decodeScene(await answer.json());
      this.view.show(this.scene);
      this.markers.hidden = !this.scene.markers.nodes.length; // a cut body has none
      this.view.setMarkers(!this.markers.hidden && this.markers.firstChild.checked);
      this.probed = -1;
      this.view.overlay.mark(null);
    } catch {
      this.#say("the simulation does not answer; trying again"); // with the next frame
    } finally {
      this.renewing = false;
    }
  }

  #badge(frame) {
    const real = Math.round(100 * frame.realTime);
    let text = real >= 97 ? "real time" : `slower than real time: ${real} %`;
    if (frame.unbalanced > UNBALANCED) text += `; forces out of balance by ${Math.round(100 * frame.unbalanced)} %`;
    if (frame.held) text += "; the body is crushed before the tool, which is held back";
    if (frame.paused) text = "paused";
    if (frame.replaying) text = "replay";
    if (frame.failed) text = "the last step failed and was taken back";
    if (!frame.driving) text += " (watching)";
    const write = (element, said) => { if (element.textContent !== said) element.textContent = said; };
    write(this.badge, text);
    write(this.caution, (frame.tool < 0 ? this.scene.grip_caution : this.scene.tools[frame.tool]?.caution) ?? "");
    this.badge.dataset.held = String(real >= 97 || frame.paused || frame.replaying);
    write(this.pause, frame.paused ? "▶ Go on" : "❚❚ Pause");
    write(this.record, frame.recording ? "■ Stop" : "● Record");
  }

  #probe() {
    if (this.probed < 0 || !this.frame) {
      this.numbers.probe.textContent = "–";
      return;
    }
    const [points, moved] = [this.scene.points, this.frame.positions];
    const d = [0, 1, 2].map((a) => moved[3 * this.probed + a] - points[3 * this.probed + a]);
    const signed = d.map((v) => v.toFixed(2).replace("-", "−"));
    this.numbers.probe.textContent = `moved (${signed.join(", ")}) mm, ${Math.hypot(...d).toFixed(2)} mm in all`;
  }

  #markProbed() {
    if (this.probed < 0 || !this.frame) return;
    const { positions: moved } = this.frame;
    const at = new Vector3().fromArray(moved, 3 * this.probed).project(this.view.camera);
    const { clientWidth: w, clientHeight: t } = this.stage;
    this.view.overlay.mark({ x: ((at.x + 1) / 2) * w, y: ((1 - at.y) / 2) * t });
  }

  #connected(state, text = "") {
    this.#say(text);
    this.notice.forget();
    if (state !== "connected") this.badge.textContent = "not connected";
    this.badge.dataset.held = String(state === "connected");
  }

  #say(text) {
    this.message.textContent = text;
  }

  #screenshot() {
    this.view.renderFinest();
    this.view.canvas.toBlob((blob) => this.#download(blob, "naibu-live.png"));
  }

  /** Save the recorded motion as a page, or say why there is none: a link would lead away from this page. */
  async #save() {
    this.#say("");
    try {
      const answer = await fetch(`/recording${window.location.search}`);
      if (answer.ok) this.#download(await answer.blob(), "naibu-recording.html");
      else this.#say(await answer.text());
    } catch {
      this.#say("the simulation does not answer");
    }
  }

  #download(blob, name) {
    const link = h("a", { href: URL.createObjectURL(blob), download: name });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }
}

async function begin() {
  const root = document.getElementById("naibu-live");
  if (!root || !canDrawOr(root)) return;
  const answer = await fetch(`/scene${window.location.search}`);
  const token = new URLSearchParams(window.location.search).get("token") ?? "";
  window.naibuLive = new LivePage(root, decodeScene(await answer.json()), token);
}

begin();
