// Decoding of the scenes that naibu/viewer/result_page/packing.py writes, into typed arrays in mm.

/** base64 of gzip of JSON -> object. */
export async function inflate(base64) {
  const bytes = Uint8Array.from(atob(base64.trim()), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return JSON.parse(await new Response(stream).text());
}

function scaled(integers, quantum) {
  return Float32Array.from(integers, (v) => (v === null ? NaN : v * quantum));
}

/** Sum the differences along the steps: d0 = p0 - start, d1 = p1 - p0, di = pi - 2 p(i-1) + p(i-2). */
function accumulated(start, differences, quantum) {
  const out = [];
  let before = start;
  let now = start;
  for (const difference of differences) {
    const next = difference.map((d, k) => d + now[k] + (out.length < 2 ? 0 : now[k] - before[k]));
    before = now;
    now = next;
    out.push(scaled(next, quantum));
  }
  return out;
}

function running(differences) {
  const out = new Uint32Array(differences.length);
  let sum = 0;
  for (let i = 0; i < out.length; i += 1) out[i] = sum += differences[i];
  return out;
}

/** Residual of every marker (predicted - measured, full load) and its length; NaN where not measured. */
function residuals(predicted, measured) {
  const vector = predicted.map((p, i) => p - measured[i]);
  const length = new Float32Array(vector.length / 3);
  for (let i = 0; i < length.length; i += 1) length[i] = Math.hypot(vector[3 * i], vector[3 * i + 1], vector[3 * i + 2]);
  return { vector, length };
}

/** One packed scene -> the scene that SceneView.show takes. */
export function decodeScene(packed) {
  const { surface: qs, marker: qm } = packed.quantum_mm;
  const surfaces = accumulated(packed.reference_surface, packed.surfaces, qs);
  const markers = accumulated(packed.initial_markers, packed.markers, qm);
  const measured = scaled(packed.measured, qm);
  const { vector, length } = residuals(markers[markers.length - 1], measured);
  return {
    name: packed.name,
    experiment: packed.experiment,
    state: packed.state,
    faces: running(packed.faces),
    reference: scaled(packed.reference_surface, qs),
    steps: packed.steps.map((s, i) => ({ ...s, surface: surfaces[i], markers: markers[i] })),
    ids: packed.marker_ids,
    layers: packed.layer,
    sd: Float32Array.from(packed.sd_mm, (v) => (v === null ? NaN : v)),
    measured,
    residual: vector,
    residualLength: length,
  };
}

/** base64 of gzip -> bytes. */
export async function unzip(base64) {
  const bytes = Uint8Array.from(atob(base64), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** 16-bit numbers whose low bytes stand before their high bytes. */
function joined(bytes) {
  const n = bytes.length / 2;
  return Int16Array.from({ length: n }, (_, i) => bytes[i] | (bytes[n + i] << 8));
}

/** Rows of 16-bit numbers from their second differences down the rows (first row as it is, second as first difference). */
function summed(differences, width) {
  const out = differences;
  for (let i = width; i < out.length; i += 1) out[i] += i < 2 * width ? out[i - width] : 2 * out[i - width] - out[i - 2 * width];
  return out;
}

/** A motion as naibu/viewer/motion_page.py packs it -> what MotionView.show takes. */
export async function decodeMotion(packed) {
  const frames = packed.times.length;
  const reference = Float32Array.from(packed.reference);
  const displacement = summed(joined(await unzip(packed.displacement)), reference.length);
  const fields = await Promise.all(packed.fields.map(async (field) => ({ ...field, levels: await unzip(field.levels) })));
  return { ...packed, frames, reference, displacement, fields, faces: Uint32Array.from(packed.faces) };
}
