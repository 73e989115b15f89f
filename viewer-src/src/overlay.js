// SVG overlay of the canvas: axes triad, scale bar, ring around the selected marker.
import { Vector3 } from "three";

const NS = "http://www.w3.org/2000/svg";

function make(name, attributes, parent) {
  const element = document.createElementNS(NS, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  parent.append(element);
  return element;
}

/** Largest of 1, 2, 5 times a power of ten that is at most `value`. */
function niceFloor(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [5, 2, 1].find((m) => m * power <= value) * power;
}

export class Overlay {
  constructor(host) {
    this.svg = make("svg", { class: "overlay", "aria-hidden": "true" }, host);
    this.ring = make("circle", { class: "ring", r: 11, visibility: "hidden" }, this.svg);
    this.stroke = make("polyline", { class: "stroke", points: "" }, this.svg);
    this.triad = make("g", { class: "triad" }, this.svg);
    this.axes = ["x", "y", "z"].map((label) => {
      const group = make("g", { class: `axis axis-${label}` }, this.triad);
      const line = make("line", { x1: 0, y1: 0 }, group);
      const text = make("text", { "text-anchor": "middle", "dominant-baseline": "central" }, group);
      text.textContent = label;
      return { group, line, text };
    });
    this.bar = make("g", { class: "scalebar" }, this.svg);
    this.barLine = make("path", {}, this.bar);
    this.barText = make("text", { "text-anchor": "middle", y: -7 }, this.bar);
  }

  update(camera, width, height) {
    this.#updateTriad(camera, height);
    const pxPerMm = (height * camera.zoom) / (camera.top - camera.bottom);
    const length = niceFloor(Math.max(70, 0.14 * width) / pxPerMm);
    const px = length * pxPerMm;
    this.bar.setAttribute("transform", `translate(${width - px - 18},${height - 18})`);
    this.barLine.setAttribute("d", `M0 -5V0H${px.toFixed(1)}V-5`);
    this.barText.setAttribute("x", (px / 2).toFixed(1));
    this.barText.textContent = `${Number(length.toPrecision(3))} mm`;
  }

  #updateTriad(camera, height) {
    this.triad.setAttribute("transform", `translate(48,${height - 48})`);
    const ends = this.axes.map((axis, k) => {
      const v = new Vector3().setComponent(k, 1).applyQuaternion(camera.quaternion.clone().invert());
      axis.line.setAttribute("x2", (27 * v.x).toFixed(1));
      axis.line.setAttribute("y2", (-27 * v.y).toFixed(1));
      const flat = Math.hypot(v.x, v.y);
      const reach = flat > 0.15 ? 1 + 9 / (27 * flat) : 1;
      axis.text.setAttribute("x", (27 * v.x * reach + (flat > 0.15 ? 0 : 10)).toFixed(1));
      axis.text.setAttribute("y", (-27 * v.y * reach - (flat > 0.15 ? 0 : 10)).toFixed(1));
      return { axis, depth: v.z };
    });
    ends.sort((p, q) => p.depth - q.depth).forEach(({ axis }) => this.triad.append(axis.group));
  }

  /** Draw a line through points [[x, y], ...] in px; none removes it. */
  draw(points) {
    this.stroke.setAttribute("points", points.map((p) => p.join()).join(" "));
  }

  /** Show the ring at `at` ({x, y} in px), or hide it with null. */
  mark(at) {
    this.ring.setAttribute("visibility", at ? "visible" : "hidden");
    if (!at) return;
    this.ring.setAttribute("cx", at.x.toFixed(1));
    this.ring.setAttribute("cy", at.y.toFixed(1));
  }
}
