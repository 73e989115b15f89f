// Readings of a frame: a plot for all that share axes, with their numbers and 95 % intervals above it.
import { h } from "./elements.js";
import { TimeCurve, curveColour } from "./time-curve.js";

const digits = (value) => String(Number(value.toPrecision(3))).replace("-", "−");

export class ReadingPlots {
  constructor(readings) {
    this.texts = readings.map(() => h("strong", {}, "–"));
    this.states = readings.map((r) => r.states);
    const flags = readings.flatMap((r, i) => (r.states.length ? [h("p", { class: "reading state" }, `${r.name}: `, this.texts[i])] : []));
    const plotted = new Set(readings.filter((r) => !r.states.length).map((r) => r.plot));
    this.plots = [...plotted].map((plot) => this.#plot(plot, readings));
    this.units = readings.map((r) => (r.unit === "degrees" ? "°" : r.unit && ` ${r.unit}`));
    this.element = h("section", { class: "readings", "aria-label": "Readings" }, ...flags, ...this.plots.map((p) => p.element));
  }

  /** The curves of one plot, and their numbers. */
  #plot(plot, readings) {
    const members = readings.map((_, i) => i).filter((i) => readings[i].plot === plot && !readings[i].states.length);
    const lines = members.map((i, k) => {
      const swatch = h("span", { class: "swatch", "aria-hidden": "true" });
      swatch.style.background = `var(${curveColour(k)})`;
      return h("p", { class: "reading" }, swatch, `${readings[i].name} `, this.texts[i],
        ...(readings[i].explanation ? [h("span", { class: "note" }, ` ${readings[i].explanation}`)] : []));
    });
    const { unit } = readings[members[0]];
    const canvas = h("canvas", { class: "time-curve", role: "img", "aria-label": `${plot} of the last ten seconds` });
    const curve = new TimeCurve(canvas, unit ? `${plot} (${unit})` : plot, members.length);
    return { members, curve, element: h("div", {}, ...lines, canvas) };
  }

  /** Take the readings of a frame: three numbers each. */
  add(time, values) {
    this.values = values;
    this.plots.forEach(({ curve, members }) => curve.add(time, members.map((i) => this.#of(i))));
  }

  #of(i) {
    return [...this.values.subarray(3 * i, 3 * i + 3)];
  }

  /** Write the last readings. */
  write() {
    this.texts.forEach((text, i) => {
      const [value, low, high] = this.#of(i);
      const interval = Number.isFinite(low) ? ` (${digits(low)} to ${digits(high)})` : "";
      if (this.states[i].length) {
        text.textContent = Number.isFinite(value) ? this.states[i][value > 0 ? 1 : 0] : "–";
        text.classList.toggle("on", value > 0);
        return;
      }
      text.textContent = Number.isFinite(value) ? `${digits(value)}${this.units[i]}${interval}` : "–";
    });
  }

  /** Draw the curves. */
  draw() {
    this.plots.forEach(({ curve }) => curve.draw());
  }
}
