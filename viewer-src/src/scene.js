// The 3-D view, apart from any page: result page, live page and notebook use the same class.
import { Box3, DirectionalLight, HemisphereLight, OrthographicCamera, Scene, Sphere, Vector3, WebGLRenderer } from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { Body } from "./body.js";
import { niceCeiling, residualColour } from "./colormap.js";
import { Arrows, measuredGlyphs, place, predictedGlyphs } from "./glyphs.js";
import { Overlay } from "./overlay.js";

export const VIEWS = {
  oblique: { label: "Oblique", from: [0.62, -1.25, 0.6] },
  front: { label: "Front (x, z)", from: [0, -1, 0] },
  side: { label: "Side (y, z)", from: [1, 0, 0] },
  top: { label: "Top (x, y)", from: [0, 0, 1] },
};
const PICK_RADIUS_PX = 16;
const FULL = 1e-6;

/** True if the browser can draw: asked on a canvas of its own, so that a refusal leaves no error in the console. */
export function canDraw() {
  try {
    const context = document.createElement("canvas").getContext("webgl2");
    context?.getExtension("WEBGL_lose_context")?.loseContext();
    return Boolean(context);
  } catch {
    return false;
  }
}

/** Colours of the page as CSS variables of `element`. */
function readTheme(element) {
  const style = getComputedStyle(element);
  const of = (name) => style.getPropertyValue(`--scene-${name}`).trim();
  return {
    dark: of("dark") === "1",
    background: of("background"),
    measured: of("measured"),
    predicted: of("predicted"),
    skin: of("skin"),
    skinOpacity: Number(of("skin-opacity")),
    edge: of("edge"),
    free: of("free"),
    grid: of("grid"),
    box: of("box"),
  };
}

/** Corners of [centre x, y, z, half size x, y, z] as a flat list. */
function boxCorners(box) {
  const signs = [-1, 1];
  return signs.flatMap((i) => signs.flatMap((j) => signs.flatMap((k) => [i, j, k].map((s, axis) => box[axis] + s * box[3 + axis]))));
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

export class SceneView {
  /** @param {HTMLElement} host empty, positioned element; @param {{onPick?: (index: number|null, at: {x,y}|null) => void}} events */
  constructor(host, events = {}) {
    this.host = host;
    this.onPick = events.onPick ?? (() => {});
    this.renderer = new WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.canvas = this.renderer.domElement;
    host.append(this.canvas);
    this.overlay = new Overlay(host);
    this.camera = new OrthographicCamera(-1, 1, 1, -1, 0.1, 10);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, this.canvas);
    this.controls.addEventListener("change", () => this.requestRender());
    this.visible = { measured: true, predicted: true, arrows: true, skin: true, free: true, boxes: true };
    this.load = 0;
    this.magnification = 1;
    this.selected = null;
    this.resizing = new ResizeObserver(() => this.resize());
    this.resizing.observe(host);
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
    this.world?.traverse((o) => { o.geometry?.dispose(); o.material?.dispose(); });
    this.world = new Scene();
    this.extent = new Sphere();
    const box = new Box3();
    const full = data.steps[data.steps.length - 1];
    this.frameful = [data.free, full.surface, ...full.boxes.map(boxCorners)];
    for (const points of [data.free, full.surface]) box.union(new Box3().setFromArray(points));
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

  /** Largest round factor with which a typical arrow stays short beside the object and the markers' spacing. */
  suggestedMagnification() {
    const known = [...this.data.residualLength].filter(Number.isFinite);
    if (known.length === 0) return 1;
    const rms = Math.sqrt(known.reduce((s, r) => s + r * r, 0) / known.length);
    const longest = Math.min(this.extent.radius / 9, this.spacing);
    return [20, 10, 5, 2, 1].find((m) => m * rms < longest) ?? 1;
  }

  /** @param {number} step 0 (free) to number of steps - 1 (full load); fractions are interpolated */
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
    place(this.measured, this.data.measured, radius);
    if (this.markers) place(this.predicted, this.markers, 2 * radius);
    this.arrows.place(this.data.measured, this.data.residual, this.magnification, 0.36 * radius);
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
    this.body.free.visible = this.visible.free;
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

  /** Look from one of VIEWS and fit the object into the frame. */
  look(name) {
    const { center, radius } = this.extent;
    const forward = new Vector3(...VIEWS[name].from).normalize();
    this.controls.target.copy(center);
    this.camera.position.copy(center).addScaledVector(forward, 6 * radius);
    this.camera.near = 0.1 * radius;
    this.camera.far = 20 * radius;
    this.camera.zoom = 1;
    this.controls.update();
    this.camera.updateMatrixWorld();
    this.#frame();
    this.resize();
  }

  /** Half extents of all that is drawn, as the camera now sees it, and the point in their middle as the new target. */
  #frame() {
    const [right, up] = [0, 1].map((k) => new Vector3().setFromMatrixColumn(this.camera.matrixWorld, k));
    const low = [Infinity, Infinity];
    const high = [-Infinity, -Infinity];
    const p = new Vector3();
    for (const points of this.frameful) {
      for (let i = 0; i < points.length; i += 3) {
        p.fromArray(points, i).sub(this.extent.center);
        [right, up].forEach((axis, k) => {
          low[k] = Math.min(low[k], p.dot(axis));
          high[k] = Math.max(high[k], p.dot(axis));
        });
      }
    }
    const shift = right.clone().multiplyScalar((low[0] + high[0]) / 2).addScaledVector(up, (low[1] + high[1]) / 2);
    this.controls.target.add(shift);
    this.camera.position.add(shift);
    this.controls.update();
    this.half = [0, 1].map((k) => (high[k] - low[k]) / 2);
  }

  zoomBy(factor) {
    this.camera.zoom = Math.min(40, Math.max(0.2, this.camera.zoom * factor));
    this.camera.updateProjectionMatrix();
    this.requestRender();
  }

  /** Turn the camera about the object, radians. */
  turn(azimuth, elevation) {
    const { target } = this.controls;
    const arm = this.camera.position.clone().sub(target);
    const r = arm.length();
    const theta = Math.atan2(arm.y, arm.x) + azimuth;
    const phi = Math.min(1.5707, Math.max(-1.5707, Math.asin(arm.z / r) + elevation));
    this.camera.position.set(Math.cos(phi) * Math.cos(theta), Math.cos(phi) * Math.sin(theta), Math.sin(phi)).multiplyScalar(r).add(target);
    this.controls.update();
    this.requestRender();
  }

  resize() {
    const { clientWidth: w, clientHeight: h } = this.host;
    if (!w || !h || !this.half) return;
    this.renderer.setSize(w, h, false);
    // 30 px are left free on every side, for the triad and the scale bar
    const half = Math.max((this.half[1] * h) / (h - 60), (this.half[0] * h) / (w - 60));
    Object.assign(this.camera, { top: half, bottom: -half, right: (half * w) / h, left: (-half * w) / h });
    this.camera.updateProjectionMatrix();
    this.requestRender();
  }

  requestRender() {
    if (this.pending || !this.world) return;
    this.pending = requestAnimationFrame(() => { this.pending = 0; this.render(); });
  }

  render() {
    if (this.camera.zoom !== this.placedZoom) this.#placeGlyphs();
    this.sun.position.copy(this.camera.position).sub(this.controls.target).applyAxisAngle(this.camera.up, 0.5);
    this.renderer.render(this.world, this.camera);
    this.overlay.update(this.camera, this.host.clientWidth, this.host.clientHeight);
    this.overlay.mark(this.selected === null ? null : this.screenPoint(this.selected));
  }

  /** Where marker i is seen, px from the host's upper left corner. */
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

  /** Move marker i into the middle if it lies outside the frame. */
  reveal(i) {
    const { x, y } = this.screenPoint(i);
    if (x > 20 && y > 20 && x < this.host.clientWidth - 20 && y < this.host.clientHeight - 20) return;
    const shift = new Vector3().fromArray(this.markers, 3 * i).sub(this.controls.target);
    this.controls.target.add(shift);
    this.camera.position.add(shift);
    this.controls.update();
    this.camera.updateMatrixWorld();
  }

  /** Choose marker number i (its place in the list), or none with null. */
  select(i) {
    if (i === null && this.selected === null) return;
    this.selected = i;
    this.onPick(i, i === null ? null : this.screenPoint(i));
    this.requestRender();
  }

  dispose() {
    this.resizing.disconnect();
    this.controls.dispose();
    this.renderer.dispose();
    this.canvas.remove();
    this.overlay.svg.remove();
  }
}
