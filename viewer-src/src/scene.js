// The 3-D view of a result: markers, residuals and body, for the result page, the live page and the notebook.
import { Box3, DirectionalLight, HemisphereLight, Quaternion, Scene, Sphere, Vector3 } from "three";
import { Body } from "./body.js";
import { niceCeiling, residualColour } from "./colormap.js";
import { Arrows, measuredGlyphs, predictedGlyphs, setPositions } from "./glyphs.js";
import { readTheme, View } from "./view.js";

const PICK_RADIUS_PX = 16;
const FULL = 1e-6;

/** Corners of [centre x, y, z, half size x, y, z, quaternion x, y, z, w] as a flat list. */
function boxCorners(box) {
  const signs = [-1, 1];
  const centre = new Vector3().fromArray(box);
  const turned = new Quaternion().fromArray(box, 6);
  const corner = (i, j, k) => new Vector3(i * box[3], j * box[4], k * box[5]).applyQuaternion(turned).add(centre).toArray();
  return signs.flatMap((i) => signs.flatMap((j) => signs.flatMap((k) => corner(i, j, k))));
}

/** Median distance of a point to its nearest neighbour; Infinity for a single one. */
function medianSpacing(points) {
  const nearest = [];
  for (let i = 0; i < points.length; i += 3) {
    let least = Infinity;
    for (let j = 0; j < points.length; j += 3) {
      if (i !== j) least = Math.min(least, Math.hypot(points[i] - points[j], points[i + 1] - points[j + 1], points[i + 2] - points[j + 2]));
    }
    nearest.push(least);
  }
  return nearest.sort((p, q) => p - q)[nearest.length >> 1] ?? Infinity;
}

export class SceneView extends View {
  /** @param {HTMLElement} host empty, positioned element; @param {{onPick?: (index: number|null, at: {x,y}|null) => void}} events */
  constructor(host, events = {}) {
    super(host);
    this.onPick = events.onPick ?? (() => {});
    this.visible = { measured: true, predicted: true, arrows: true, skin: true, reference: true, boxes: true };
    this.load = 0;
    this.magnification = 1;
    this.selected = null;
    this.#listen();
  }

  #listen() {
    this.canvas.addEventListener("pointermove", (e) => { if (e.buttons === 0) this.#pickAt(e); });
    this.canvas.addEventListener("pointerdown", (e) => this.#pickAt(e));
    this.canvas.addEventListener("pointerleave", (e) => { if (e.pointerType === "mouse") this.select(null); });
  }

  /** Show a decoded scene at full load. */
  show(data) {
    this.data = data;
    this.clear();
    this.world = new Scene();
    this.extent = new Sphere();
    const box = new Box3();
    const full = data.steps[data.steps.length - 1];
    this.frameful = [data.reference, full.surface, ...full.boxes.map(boxCorners)];
    for (const points of [data.reference, full.surface]) box.union(new Box3().setFromArray(points));
    box.getBoundingSphere(this.extent);
    this.spacing = medianSpacing(full.markers);
    this.glyph = Math.min(0.0145 * this.extent.radius, 0.105 * this.spacing);
    this.body = new Body(data, niceCeiling(this.extent.radius / 6.5));
    this.measured = measuredGlyphs(data.ids.length);
    this.predicted = predictedGlyphs(data.ids.length);
    this.arrows = new Arrows(data.ids.length);
    this.sun = new DirectionalLight(0xffffff, 1.6);
    this.world.add(...this.body.objects, this.measured, this.predicted, ...this.arrows.meshes, new HemisphereLight(0xffffff, 0x8a8a8a, 2.2), this.sun);
    this.selected = null;
    this.markers = null;
    this.largest = data.residualLength.reduce((m, r) => (r > m ? r : m), 0);
    this.colourLimit = niceCeiling(this.largest);
    this.applyTheme();
    this.setLoad(data.steps.length - 1);
    this.look("oblique");
  }

  get atFullLoad() {
    return this.load >= this.data.steps.length - 1 - FULL;
  }

  /** Largest round factor at which a typical arrow stays short relative to the object and the marker spacing. */
  suggestedMagnification() {
    const known = [...this.data.residualLength].filter(Number.isFinite);
    if (known.length === 0) return 1;
    const rms = Math.sqrt(known.reduce((s, r) => s + r * r, 0) / known.length);
    const longest = Math.min(this.extent.radius / 9, this.spacing);
    return [20, 10, 5, 2, 1].find((m) => m * rms < longest) ?? 1;
  }

  /** @param {number} step 0 (unloaded) to number of steps - 1 (full load); fractions are interpolated */
  setLoad(step) {
    const { steps } = this.data;
    this.load = Math.min(steps.length - 1, Math.max(0, step));
    const i = Math.min(steps.length - 1, Math.floor(this.load));
    const [a, b, t] = [steps[i], steps[Math.min(steps.length - 1, i + 1)], this.load - i];
    this.body.blend(a, b, t);
    this.markers = a.markers.map((p, k) => p + t * (b.markers[k] - p));
    this.#placeGlyphs();
    this.#applyVisible();
  }

  setMagnification(factor) {
    this.magnification = factor;
    this.#placeGlyphs();
    this.requestRender();
  }

  /** Glyphs grow less than the object when zooming in, so that close by the distance between both markers is seen at its true size. */
  #placeGlyphs() {
    this.placedZoom = this.camera.zoom;
    const radius = this.glyph * Math.max(1, this.camera.zoom) ** -0.7;
    setPositions(this.measured, this.data.measured, radius);
    if (this.markers) setPositions(this.predicted, this.markers, 2 * radius);
    this.arrows.setVectors(this.data.measured, this.data.residual, this.magnification, 0.36 * radius);
  }

  setVisible(what, on) {
    this.visible[what] = on;
    this.#applyVisible();
  }

  #applyVisible() {
    this.measured.visible = this.visible.measured;
    this.measured.material.opacity = this.atFullLoad ? 1 : 0.35;
    this.predicted.visible = this.visible.predicted;
    this.arrows.visible = this.visible.arrows && this.atFullLoad;
    this.body.skin.visible = this.body.edges.visible = this.visible.skin;
    this.body.reference.visible = this.visible.reference;
    this.body.boxes.visible = this.visible.boxes;
    this.requestRender();
  }

  /** Read the colours again from the page, after it turned light or dark. */
  applyTheme() {
    const theme = readTheme(this.host);
    this.theme = theme;
    this.renderer.setClearColor(theme.background);
    this.body.paint(theme);
    this.measured.material.color.set(theme.measured);
    this.predicted.material.color.set(theme.predicted);
    this.arrows.paint((i) => residualColour(this.data.residualLength[i] / this.colourLimit || 0, theme.dark));
    this.requestRender();
  }

  render() {
    if (this.camera.zoom !== this.placedZoom) this.#placeGlyphs();
    super.render();
    this.overlay.mark(this.selected === null ? null : this.screenPoint(this.selected));
  }

  /** Screen position of marker i, px from the host's upper left corner. */
  screenPoint(i) {
    const points = this.atFullLoad && Number.isFinite(this.data.residualLength[i]) ? this.data.measured : this.markers;
    const v = new Vector3().fromArray(points, 3 * i).project(this.camera);
    return { x: (0.5 + 0.5 * v.x) * this.host.clientWidth, y: (0.5 - 0.5 * v.y) * this.host.clientHeight, depth: v.z };
  }

  #pickAt(event) {
    const frame = this.canvas.getBoundingClientRect();
    const [x, y] = [event.clientX - frame.left, event.clientY - frame.top];
    let best = null;
    let bestDistance = PICK_RADIUS_PX;
    for (let i = 0; i < this.data.ids.length; i += 1) {
      const p = this.screenPoint(i);
      const distance = Math.hypot(p.x - x, p.y - y) + p.depth;
      if (distance < bestDistance) [best, bestDistance] = [i, distance];
    }
    this.select(best);
  }

  /** Centre the view on marker i if it lies outside the frame. */
  reveal(i) {
    const { x, y } = this.screenPoint(i);
    if (x > 20 && y > 20 && x < this.host.clientWidth - 20 && y < this.host.clientHeight - 20) return;
    const shift = new Vector3().fromArray(this.markers, 3 * i).sub(this.controls.target);
    this.controls.target.add(shift);
    this.camera.position.add(shift);
    this.controls.update();
    this.camera.updateMatrixWorld();
  }

  /** Select marker i (its index in the list), or none with null. */
  select(i) {
    if (i === null && this.selected === null) return;
    this.selected = i;
    this.onPick(i, i === null ? null : this.screenPoint(i));
    this.requestRender();
  }
}
