// viridis (matplotlib, CC0), sampled at equal steps; perceptually uniform.
const VIRIDIS = [
  "#440154", "#482475", "#414487", "#355f8d", "#2a788e", "#21918c", "#22a884", "#44bf70", "#7ad151", "#bddf26", "#fde725",
].map((hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255));

/** Colour (sRGB, 0..1) of `t` in 0..1. Large values always stand out: bright on a dark ground, dark on a light one. */
export function residualColour(t, dark) {
  const inside = Math.min(1, Math.max(0, t));
  const u = dark ? 0.16 + 0.84 * inside : 0.9 * (1 - inside);
  const s = u * (VIRIDIS.length - 1);
  const i = Math.min(VIRIDIS.length - 2, Math.floor(s));
  return VIRIDIS[i].map((c, k) => c + (s - i) * (VIRIDIS[i + 1][k] - c));
}

/** The same map as a CSS gradient, for the colour bar. */
export function residualGradient(dark) {
  const stops = Array.from({ length: 17 }, (_, i) => residualColour(i / 16, dark).map((c) => Math.round(255 * c)));
  return `linear-gradient(to right, ${stops.map((c) => `rgb(${c})`).join(", ")})`;
}

/** Smallest of 1, 1.5, 2, 3, 4, 5, 6, 8 times a power of ten that is not below `value`. */
export function niceCeiling(value) {
  if (!(value > 0)) return 1;
  const power = 10 ** Math.floor(Math.log10(value));
  const step = [1, 1.5, 2, 3, 4, 5, 6, 8, 10].find((m) => m * power >= value * 0.999999);
  return step * power;
}

// Diverging map of equal lightness on both sides (ColorBrewer RdBu), for values of either sign.
const DIVERGING = ["#2166ac", "#67a9cf", "#d1e5f0", "#f7f7f7", "#fddbc7", "#ef8a62", "#b2182b"]
  .map((hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255));

/** 256 colours as RGBA bytes: viridis from dark to bright, or diverging about the middle. */
export function colourTable(diverging) {
  const stops = diverging ? DIVERGING : VIRIDIS;
  const out = new Uint8Array(4 * 256);
  for (let i = 0; i < 256; i += 1) {
    const s = (i / 255) * (stops.length - 1);
    const k = Math.min(stops.length - 2, Math.floor(s));
    for (let c = 0; c < 3; c += 1) out[4 * i + c] = Math.round(255 * (stops[k][c] + (s - k) * (stops[k + 1][c] - stops[k][c])));
    out[4 * i + 3] = 255;
  }
  return out;
}

/** The same map as a CSS gradient. */
export function tableGradient(diverging) {
  const table = colourTable(diverging);
  const stops = Array.from({ length: 17 }, (_, i) => Math.round((255 * i) / 16)).map((i) => `rgb(${table.slice(4 * i, 4 * i + 3).join(",")})`);
  return `linear-gradient(to right, ${stops.join(", ")})`;
}
