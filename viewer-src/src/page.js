// The result page: adds the 3-D view and its controls to #naibu-viewer. All tables and figures are already in the HTML.
import { residualGradient } from "./colormap.js";
import { decodeScene, inflate } from "./decode.js";
import { canDrawOr, h } from "./elements.js";
import { SceneView } from "./scene.js";
import { VIEWS } from "./view.js";

const PLAY_SECONDS = 3;

const mm = (value) => (Number.isFinite(value) ? value.toFixed(2) : "–");
const signed = (value) => (Number.isFinite(value) ? `${value < 0 ? "−" : "+"}${Math.abs(value).toFixed(2)}` : "–");
const WORDS = {
  choice: "Experiment and state", measured: "measured marker (loaded)", predicted: "predicted marker", arrow: "residual arrow", difference: "residual",
  bar: "Residual, measured → predicted (mm)", part: "Residuals are shown at full load only, where markers were measured.",
  none: "No marker of this state was measured; only the prediction is shown.", lacking: "not measured in this state",
  missing: "markers lack a measured coordinate in this state.", load: "Load", from: "none", to: "full",
};
const sceneLabel = (s) => [s.experiment, s.state].filter(Boolean).join(" · ") || s.name;

class ViewerPage {
  constructor(root, packed) {
    this.root = root;
    this.words = { ...WORDS, ...JSON.parse(root.dataset.words ?? "{}") };
    this.packed = packed;
    this.decoded = new Map();
    this.#build();
    this.view = new SceneView(this.stage, { onPick: (i, at) => this.#tip(i, at) });
    this.stage.append(this.tip);
    this.view.listenToKeys({ n: () => this.#walk(1), p: () => this.#walk(-1), Escape: () => this.view.select(null) });
    const colours = window.matchMedia("(prefers-color-scheme: dark)");
    colours.addEventListener("change", () => this.#theme());
    window.matchMedia("print").addEventListener("change", () => { this.#theme(); this.view.render(); });
    this.show(0);
  }

  #build() {
    this.choice = h("select", { id: "naibu-scene", onchange: () => this.show(Number(this.choice.value)) },
      ...this.packed.map((s, i) => h("option", { value: i }, s.role ? `${sceneLabel(s)} (${s.role})` : sceneLabel(s))));
    const views = h("div", { class: "buttons", role: "group", "aria-label": "View from" },
      ...Object.entries(VIEWS).filter(([key]) => key !== "oblique").map(([key, { label }]) => h("button", { type: "button", onclick: () => this.view.look(key) }, label)),
      h("button", { type: "button", "aria-label": "Zoom in", onclick: () => this.view.zoomBy(1.25) }, "+"),
      h("button", { type: "button", "aria-label": "Zoom out", onclick: () => this.view.zoomBy(0.8) }, "−"),
      h("button", { type: "button", onclick: () => this.view.look("oblique") }, "Reset view"));
    this.stage = h("div", { class: "stage", tabindex: 0, role: "application", "aria-label": `3-D view. Arrow keys rotate, plus and minus zoom, R resets, N and P step through the markers by ${this.words.difference}.` });
    this.tip = h("div", { class: "tip", hidden: true });
    this.live = h("p", { class: "visually-hidden", "aria-live": "polite" });
    this.root.replaceChildren(
      h("div", { class: "bar" }, h("label", { for: "naibu-scene" }, this.words.choice), this.choice, views),
      this.stage,
      h("p", { class: "hint" }, "Drag to rotate, right-drag or drag with two fingers to pan. Click the view, then scroll to zoom. Point at a marker for its values."),
      this.#loadControls(), this.#legend(), this.#worst(), this.live);
  }

  #loadControls() {
    this.slider = h("input", { type: "range", id: "naibu-load", min: 0, max: 1, step: 0.05, oninput: () => { this.stop(); this.setLoad(Number(this.slider.value)); } });
    this.slider.addEventListener("keydown", (e) => {
      const way = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1 }[e.key];
      if (!way) return;
      e.preventDefault();
      this.stop();
      this.setLoad(way > 0 ? Math.floor(this.view.load + 1 + 1e-6) : Math.ceil(this.view.load - 1 - 1e-6));
    });
    this.play = h("button", { type: "button", class: "play", onclick: () => (this.timer ? this.stop() : this.start()) }, "▶ Play");
    this.stepLabel = h("output", { for: "naibu-load", class: "steplabel" });
    return h("div", { class: "load" }, this.play, h("div", { class: "slide" }, h("label", { for: "naibu-load" }, this.words.load),
      h("span", { class: "end" }, this.words.from), this.slider, h("span", { class: "end" }, this.words.to)), this.stepLabel);
  }

  #toggle(what, icon, ...text) {
    const box = h("input", { type: "checkbox", checked: true, onchange: () => this.view.setVisible(what, box.checked) });
    const glyph = h("span", { class: "glyph", "aria-hidden": "true" });
    glyph.innerHTML = `<svg viewBox="0 0 20 20" width="20" height="20">${icon}</svg>`;
    return h("label", { class: "toggle" }, box, glyph, h("span", {}, ...text));
  }

  #legend() {
    this.factor = h("input", { type: "range", id: "naibu-factor", min: 1, max: 20, step: 1, oninput: () => this.setFactor(Number(this.factor.value)) });
    this.factorLabel = h("output", { for: "naibu-factor" });
    this.gradient = h("div", { class: "gradient" });
    this.ticks = h("div", { class: "ticks" });
    this.arrowNote = h("p", { class: "arrow-note" });
    const toggles = h("fieldset", { class: "toggles" }, h("legend", {}, "Shown"),
      this.#toggle("measured", '<circle cx="10" cy="10" r="5" class="g-measured"/>', this.words.measured),
      this.#toggle("predicted", '<path d="M10 2 18 10 10 18 2 10Z" class="g-predicted"/>', this.words.predicted),
      this.#toggle("arrows", '<path d="M3 17 15 5M8 4.5H15.5V12" class="g-arrow"/>', this.words.arrow),
      ...(this.packed.some((s) => s.faces.length) ? [this.#toggle("skin", '<rect x="3" y="5" width="14" height="11" class="g-skin"/>', "predicted surface"),
      this.#toggle("reference", '<rect x="3" y="4" width="14" height="13" class="g-reference"/>', "undeformed outline")] : []),
      ...(this.packed.some((s) => s.steps.some((t) => t.boxes.length)) ? [this.#toggle("boxes", '<rect x="2" y="8" width="16" height="5" class="g-box"/>', "indenters")] : []));
    return h("div", { class: "legend" }, toggles, h("div", { class: "colourbar" },
      h("p", { class: "barlabel" }, this.words.bar), this.gradient, this.ticks,
      h("div", { class: "factor" }, h("label", { for: "naibu-factor" }, "Arrow scale"), this.factor, this.factorLabel), this.arrowNote));
  }

  #worst() {
    this.worst = h("div", { class: "worst" });
    return this.worst;
  }

  show(index) {
    if (!this.decoded.has(index)) this.decoded.set(index, decodeScene(this.packed[index]));
    this.stop();
    const scene = this.decoded.get(index);
    this.scene = scene;
    this.view.show(scene);
    this.tip.hidden = true;
    this.slider.max = scene.steps.length - 1;
    this.factor.value = this.view.suggestedMagnification();
    this.setFactor(Number(this.factor.value));
    this.setLoad(scene.steps.length - 1);
    this.ranked = [...scene.residualLength.keys()].filter((i) => Number.isFinite(scene.residualLength[i]))
      .sort((p, q) => scene.residualLength[q] - scene.residualLength[p]);
    this.#listWorst();
    this.#theme();
    this.stage.setAttribute("data-ready", index);
  }

  #listWorst() {
    const known = this.ranked.length > 0;
    const missing = this.scene.ids.length - this.ranked.length;
    this.worst.replaceChildren(...(known ? [h("span", {}, `Largest ${this.words.difference}s:`),
      ...this.ranked.slice(0, 5).map((i) => h("button", { type: "button", onclick: () => this.#showMarker(i) },
        `marker ${this.scene.ids[i]}: ${mm(this.scene.residualLength[i])} mm`))] : [h("span", {}, this.words.none)]),
    ...(known && missing ? [h("span", {}, `${missing} of ${this.scene.ids.length} ${this.words.missing}`)] : []));
  }

  #showMarker(i) {
    this.stop();
    this.setLoad(Infinity);
    this.stage.scrollIntoView({ block: "nearest" });
    this.view.reveal(i);
    this.view.select(i);
  }

  setLoad(step) {
    this.view.setLoad(step);
    const { load } = this.view;
    const label = this.scene.steps[Math.round(load)].label;
    this.slider.value = load;
    this.stepLabel.value = label;
    this.slider.setAttribute("aria-valuetext", label);
    this.#noteArrows();
    if (!this.view.atFullLoad) this.view.select(null);
  }

  setFactor(factor) {
    this.view.setMagnification(factor);
    this.factorLabel.value = `${factor}× true length`;
    this.#noteArrows();
  }

  #noteArrows() {
    this.arrowNote.textContent = this.view.atFullLoad ? "" : this.words.part;
  }

  #theme() {
    this.view.applyTheme();
    this.gradient.style.background = residualGradient(this.view.theme.dark);
    const parts = [0, 1, 2, 3, 4].map((k) => (this.view.colourLimit * k) / 4);
    this.ticks.replaceChildren(...parts.map((v) => h("span", {}, String(Number(v.toPrecision(3))))));
  }

  start() {
    const last = this.scene.steps.length - 1;
    const from = this.view.atFullLoad ? 0 : this.view.load;
    const began = performance.now();
    this.play.textContent = "❚❚ Pause";
    const tick = (now) => {
      this.setLoad(from + (last * (now - began)) / (1000 * PLAY_SECONDS));
      if (this.view.atFullLoad) this.stop();
      else this.timer = requestAnimationFrame(tick);
    };
    this.timer = requestAnimationFrame(tick);
  }

  stop() {
    cancelAnimationFrame(this.timer ?? 0);
    this.timer = null;
    this.play.textContent = "▶ Play";
  }

  #tip(i, at) {
    this.tip.hidden = i === null;
    if (i === null) return;
    const { scene } = this;
    const length = scene.residualLength[i];
    const r = [0, 1, 2].map((k) => scene.residual[3 * i + k]);
    const head = `Marker ${scene.ids[i]}, ${this.words.groups?.[scene.layers[i]] ?? `layer ${scene.layers[i] + 1}`}`;
    const lines = Number.isFinite(length)
      ? [`${this.words.difference} ${mm(length)} mm`, `x ${signed(r[0])}  y ${signed(r[1])}  z ${signed(r[2])} mm`, `noise SD ${mm(scene.sd[i])} mm along each axis`]
      : [this.words.lacking, ...(r.some(Number.isFinite) ? [`x ${signed(r[0])}  y ${signed(r[1])}  z ${signed(r[2])} mm`] : [])];
    this.tip.replaceChildren(h("strong", {}, head), ...lines.map((line) => h("span", {}, line)));
    this.live.textContent = [head, ...lines].join(", ");
    this.#putTip(at);
  }

  #putTip(at) {
    const { clientWidth: w, clientHeight: v } = this.stage;
    const { offsetWidth: tw, offsetHeight: th } = this.tip;
    const left = at.x + 16 + tw < w ? at.x + 16 : at.x - 16 - tw;
    this.tip.style.left = `${Math.max(4, Math.min(w - tw - 4, left))}px`;
    this.tip.style.top = `${Math.max(4, Math.min(v - th - 4, at.y - th / 2))}px`;
  }

  #walk(way) {
    if (this.ranked.length === 0) return;
    const at = this.ranked.indexOf(this.view.selected);
    const next = at < 0 ? 0 : (at + way + this.ranked.length) % this.ranked.length;
    this.#showMarker(this.ranked[next]);
  }
}

async function begin() {
  window.addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((d) => { d.open = true; }));
  const root = document.getElementById("naibu-viewer");
  const data = document.getElementById("naibu-scenes");
  if (!root || !data || !canDrawOr(root)) return;
  const { scenes } = await inflate(data.textContent);
  window.naibuViewer = new ViewerPage(root, scenes);
}

begin();
