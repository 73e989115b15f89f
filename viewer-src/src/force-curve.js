// A curve of the last seconds on a canvas, with axes and units.
const SECONDS = 10;

export class ForceCurve {
  constructor(canvas) {
    this.canvas = canvas;
    this.samples = [];
  }

  /** Add a force, N, at a simulated time, s; a time that goes back begins anew. */
  add(time, force) {
    if (this.samples.length && time < this.samples[this.samples.length - 1][0]) this.samples = [];
    if (!this.samples.length || time > this.samples[this.samples.length - 1][0]) this.samples.push([time, force]);
    while (this.samples.length && this.samples[0][0] < time - SECONDS) this.samples.shift();
  }

  draw(niceCeiling) {
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
    const most = niceCeiling(Math.max(1e-3, ...samples.map((s) => s[1])));
    const ticks = [0, 0.5, 1].map((part) => [part * most, String(Number((part * most).toPrecision(3)))]);
    const widest = Math.max(...ticks.map(([, label]) => context.measureText(label).width));
    const [left, right, top, bottom] = [26 + widest, 8, 8, 32]; // the name of the axis stands left of the numbers
    const x = (time) => left + ((time - end + SECONDS) / SECONDS) * (width - left - right);
    const y = (force) => height - bottom - (force / most) * (height - top - bottom);
    context.fillStyle = colour("--soft");
    context.strokeStyle = colour("--line");
    context.lineWidth = 1;
    ticks.forEach(([force, label]) => {
      context.beginPath();
      context.moveTo(left, y(force));
      context.lineTo(width - right, y(force));
      context.stroke();
      context.textAlign = "right";
      context.fillText(label, left - 6, y(force) + 4);
    });
    context.textAlign = "center";
    [-10, -5, 0].forEach((t) => context.fillText(t === 0 ? "now" : `${t} s`.replace("-", "−"), Math.min(width - 16, x(end + t)), height - bottom + 14));
    context.save();
    context.translate(11, (height - bottom + top) / 2);
    context.rotate(-Math.PI / 2);
    context.fillText("force (N)", 0, 0);
    context.restore();
    context.strokeStyle = colour("--accent");
    context.lineWidth = 1.8;
    context.beginPath();
    samples.forEach(([time, force], i) => (i ? context.lineTo(x(time), y(force)) : context.moveTo(x(time), y(force))));
    context.stroke();
  }
}
