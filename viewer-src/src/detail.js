// How finely a picture is drawn where a processor draws it: coarser as long as that takes too long, finer again when it would not.

/** From the finest: pixels of the canvas for one of the screen, along one side, and nodes of the surface. */
const LEVELS = [
  { ratio: 1, nodes: Infinity },
  { ratio: 1, nodes: 12_000 },
  { ratio: 0.75, nodes: 6_000 },
  { ratio: 0.5, nodes: 3_000 },
];
export const STILL_RATIO = 2; // of a picture that does not change: it is drawn once
export const STILL_MS = 200;
const LIMIT_MS = 9; // of drawing, in a frame of 1000 / 60 ms
const FINER = 0.6; // of the limit that the finer level may be expected to take
const EVERY = 8; // frames from one that is timed to the next
const UNTIMED = 4; // first frames, for which shaders are compiled
const MEDIAN_OF = 3;
const MS_PER_FACE = 2.5e-4; // a triangle costs as much as some ten pixels
const MS_PER_PIXEL = 2e-5;

export class Detail {
  /** @param {number} nodes nodes of the whole surface; @param {number} pixels of the screen */
  constructor(nodes, pixels) {
    this.nodes = nodes;
    this.pixels = pixels;
    this.levels = LEVELS.filter((level, k) => k === 0 || level.nodes < nodes || level.ratio < LEVELS[k - 1].ratio); // no two alike
    this.number = 0;
    this.frames = -UNTIMED;
    this.times = [];
  }

  get level() {
    return this.levels[this.number];
  }

  /** Whether the frame that is about to be drawn is to be timed. */
  get due() {
    this.frames += 1;
    return this.frames > 0 && this.frames % EVERY === 0;
  }

  /** What drawing at a level is expected to take, in proportion. */
  #work({ ratio, nodes }) {
    return 2 * Math.min(nodes, this.nodes) * MS_PER_FACE + this.pixels * ratio * ratio * MS_PER_PIXEL;
  }

  /** Note the time that a frame took, ms, and choose the level of the next ones. */
  took(time) {
    this.times.push(time);
    if (this.times.length < MEDIAN_OF) return;
    const median = this.times.sort((p, q) => p - q)[MEDIAN_OF >> 1];
    this.times = [];
    const [finer, now, coarser] = [-1, 0, 1].map((step) => this.levels[this.number + step]);
    if (median > LIMIT_MS && coarser) this.number += 1;
    else if (finer && (median * this.#work(finer)) / this.#work(now) < FINER * LIMIT_MS) this.number -= 1;
  }
}
