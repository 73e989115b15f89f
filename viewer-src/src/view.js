// Base class of the 3-D views: camera, rotation, fitting into the frame, axes and scale bar. Subclasses add the content.
import { OrthographicCamera, Vector3, WebGLRenderer } from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { Overlay } from "./overlay.js";

export const VIEWS = {
  oblique: { label: "Oblique", from: [0.62, -1.25, 0.6] },
  front: { label: "Front (x, z)", from: [0, -1, 0] },
  side: { label: "Side (y, z)", from: [1, 0, 0] },
  top: { label: "Top (x, y)", from: [0, 0, 1] },
};

/** True if the browser can draw: asked on a canvas of its own, so that a failure leaves no error in the console. */
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
export function readTheme(element) {
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
    reference: of("reference"),
    grid: of("grid"),
    box: of("box"),
  };
}

/** Subclasses set `world` (Scene), `extent` (Sphere), `frameful` (lists of points that must be visible) and `sun` (a light), then call look(). */
export class View {
  /**
   * @param {HTMLElement} host empty, positioned element
   * @param {{antialias?: boolean, preserveDrawingBuffer?: boolean}} drawing how the canvas is drawn; by default smooth, and kept for copies
   */
  constructor(host, { antialias = true, preserveDrawingBuffer = true } = {}) {
    this.host = host;
    this.renderer = new WebGLRenderer({ antialias, preserveDrawingBuffer });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.canvas = this.renderer.domElement;
    host.append(this.canvas);
    this.overlay = new Overlay(host);
    this.camera = new OrthographicCamera(-1, 1, 1, -1, 0.1, 10);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, this.canvas);
    this.controls.addEventListener("change", () => this.requestRender());
    this.resizing = new ResizeObserver(() => this.resize());
    this.resizing.observe(host);
    this.#guardWheel();
  }

  /** The wheel scrolls the page until the view has been clicked. */
  #guardWheel() {
    let clicked = false;
    this.host.addEventListener("wheel", (e) => {
      if (!clicked && !e.ctrlKey) e.stopImmediatePropagation();
    }, { capture: true, passive: true });
    this.host.addEventListener("pointerdown", () => {
      clicked = true;
      this.host.focus({ preventScroll: true });
    }, { capture: true });
    this.host.addEventListener("mouseleave", () => { clicked = false; });
  }

  /** Bind the keys that rotate and zoom, and more of them: name -> action. */
  listenToKeys(more = {}) {
    const actions = {
      ArrowLeft: () => this.turn(-0.1, 0),
      ArrowRight: () => this.turn(0.1, 0),
      ArrowUp: () => this.turn(0, 0.1),
      ArrowDown: () => this.turn(0, -0.1),
      "+": () => this.zoomBy(1.2),
      "=": () => this.zoomBy(1.2),
      "-": () => this.zoomBy(1 / 1.2),
      r: () => this.look("oblique"),
      ...more,
    };
    this.host.addEventListener("keydown", (e) => {
      const action = actions[e.key.length === 1 ? e.key.toLowerCase() : e.key];
      if (!action || e.ctrlKey || e.metaKey || e.altKey) return;
      e.preventDefault();
      action();
    });
  }

  /** Dispose of the previous content. */
  clear() {
    this.world?.traverse((o) => { o.geometry?.dispose(); o.material?.dispose(); });
  }

  /** View from one of VIEWS and fit the content into the frame. */
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

  /** Centre the content as the camera sees it, and set `half`, its half extents. */
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

  /** Length that a pixel of the screen shows, mm. */
  get mmPerPx() {
    return (this.camera.top - this.camera.bottom) / (this.camera.zoom * this.host.clientHeight);
  }

  requestRender() {
    if (this.pending || !this.world) return;
    this.pending = requestAnimationFrame(() => this.render());
  }

  /** Draw at once; a picture that was asked for before is this one. */
  render() {
    cancelAnimationFrame(this.pending);
    this.pending = 0;
    this.sun.position.copy(this.camera.position).sub(this.controls.target).applyAxisAngle(this.camera.up, 0.5);
    this.renderer.render(this.world, this.camera);
    this.overlay.update(this.camera, this.host.clientWidth, this.host.clientHeight);
  }

  dispose() {
    this.resizing.disconnect();
    this.controls.dispose();
    this.renderer.dispose();
    this.canvas.remove();
    this.overlay.svg.remove();
  }
}
