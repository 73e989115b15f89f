// Curves of the last seconds on a canvas, with axes and units, and bands for intervals.
import { niceCeiling } from "./colormap.js";

const SECONDS = 10;
const COLOURS = ["--accent", "--scene-predicted"];

/** Name of the colour of a curve, by its number. */
export const curveColour = (k) => COLOURS[k % COLOURS.length];

export class TimeCurve {
  /** Curves on a canvas; `label` names the axis, with its unit, and `parts` is how many there are. */
  constructor(canvas, label, parts = 1) {
    this.canvas = canvas;
    this.label = label;
    this.parts = parts;
    this.samples = [];
  }

  /** Add, for every curve, value and ends of its interval, NaN where there is none, at a simulated time, s; one that goes back begins anew. */
  add(time, values) {
    if (this.samples.length && time < this.samples[this.samples.length - 1][0]) this.samples = [];
    if (!this.samples.length || time > this.samples[this.samples.length - 1][0]) this.samples.push([time, values]);
    while (this.samples.length && this.samples[0][0] < time - SECONDS) this.samples.shift();
  }

  /** Smallest and largest value of the axis: it begins at 0, or lies evenly about it where there are negative values. */
  #range() {
    const all = this.samples.flatMap(([, values]) => values.flat()).filter(Number.isFinite);
    const most = niceCeiling(Math.max(1e-3, ...all.map(Math.abs)));
    return [all.some((v) => v < 0) ? -most : 0, most];
  }

  draw() {
    const { canvas, samples } = this;
    const ratio = Math.min(window.devicePixelRatio, 2);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    if (canvas.width !== Math.round(width * ratio)) [canvas.width, canvas.height] = [width * ratio, height * ratio].map(Math.round);
    const style = getComputedStyle(canvas);
    const colour = (name) => style.getPropertyValue(name).trim();
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    context.font = `11px ${style.fontFamily}`;
    const end = samples.length ? samples[samples.length - 1][0] : 0;
    const [low, high] = this.#range();
    const ticks = [0, 0.5, 1].map((part) => low + part * (high - low)).map((v) => [v, String(Number(v.toPrecision(3))).replace("-", "−")]);
    const widest = Math.max(...ticks.map(([, label]) => context.measureText(label).width));
    const [left, right, top, bottom] = [26 + widest, 8, 8, 32]; // the name of the axis stands left of the numbers
    const x = (time) => left + ((time - end + SECONDS) / SECONDS) * (width - left - right);
    const y = (value) => height - bottom - ((value - low) / (high - low)) * (height - top - bottom);
    context.fillStyle = colour("--soft");
    context.strokeStyle = colour("--line");
    context.lineWidth = 1;
    ticks.forEach(([value, label]) => {
      context.beginPath();
      context.moveTo(left, y(value));
      context.lineTo(width - right, y(value));
      context.stroke();
      context.textAlign = "right";
      context.fillText(label, left - 6, y(value) + 4);
    });
    context.textAlign = "center";
    [-10, -5, 0].forEach((t) => context.fillText(t === 0 ? "now" : `${t} s`.replace("-", "−"), Math.min(width - 16, x(end + t)), height - bottom + 14));
    context.save();
    context.translate(11, (height - bottom + top) / 2);
    context.rotate(-Math.PI / 2);
    context.fillText(this.label, 0, 0);
    context.restore();
    for (let k = 0; k < this.parts; k += 1) {
      context.strokeStyle = colour(curveColour(k));
      context.fillStyle = colour(curveColour(k));
      this.#band(context, k, x, y);
      this.#line(context, k, x, y);
    }
  }

  #line(context, k, x, y) {
    context.lineWidth = 1.8;
    context.beginPath();
    let broken = true;
    this.samples.forEach(([time, values]) => {
      const value = values[k][0];
      if (Number.isFinite(value)) context[broken ? "moveTo" : "lineTo"](x(time), y(value));
      broken = !Number.isFinite(value);
    });
    context.stroke();
  }

  #band(context, k, x, y) {
    context.globalAlpha = 0.22;
    this.samples.forEach(([time, values], i) => {
      const before = this.samples[i - 1];
      if (!before || ![...before[1][k], ...values[k]].every(Number.isFinite)) return;
      context.beginPath();
      context.moveTo(x(before[0]), y(before[1][k][1]));
      context.lineTo(x(time), y(values[k][1]));
      context.lineTo(x(time), y(values[k][2]));
      context.lineTo(x(before[0]), y(before[1][k][2]));
      context.fill();
    });
    context.globalAlpha = 1;
  }
}
