// The inverse of naibu/viewer/live/scene.py: the scene from JSON, frames from bytes.
const FLAGS = { paused: 1, driving: 2, recording: 4, replaying: 8, failed: 16, held: 32, underWay: 64, preparing: 128 };
const HEADER_BYTES = 116;

const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;

export function decodeScene(payload) {
  return {
    ...payload,
    points: new Float32Array(bytes(payload.points)),
    faces: new Uint32Array(bytes(payload.faces)),
    cells: new Uint32Array(bytes(payload.cells)),
    outline: new Uint32Array(bytes(payload.outline)),
    markers: {
      each: payload.markers.each,
      nodes: new Uint32Array(bytes(payload.markers.nodes)),
      weights: new Float32Array(bytes(payload.markers.weights)),
    },
  };
}

/** A frame: numbers of its header, positions (3 n), values at the nodes (n) if they were asked for, and readings (3 k). */
export function decodeFrame(buffer) {
  const view = new DataView(buffer);
  const magic = String.fromCharCode(...new Uint8Array(buffer, 0, 4));
  if (magic !== "NLV5") throw new Error(`this is no frame of naibu: ${magic}`);
  const nodes = view.getUint32(8, true);
  const float = (at) => view.getFloat32(at, true);
  const vector = (at) => [float(at), float(at + 4), float(at + 8)];
  const flags = view.getUint32(12, true);
  const valued = view.getUint32(24, true) === 1;
  const afterNodes = HEADER_BYTES + (valued ? 16 : 12) * nodes;
  return {
    number: view.getUint32(4, true),
    ...Object.fromEntries(Object.entries(FLAGS).map(([name, bit]) => [name, Boolean(flags & bit)])),
    tool: view.getInt32(16, true),
    gripped: view.getInt32(20, true),
    topology: view.getUint32(28, true),
    time: float(32),
    force: vector(36),
    pull: vector(48),
    centre: vector(60),
    penetration: float(72),
    indentation: float(76),
    stepsPerSecond: float(80),
    realTime: float(84),
    unbalanced: float(88),
    rotation: [...vector(92), float(104)],
    cutStage: view.getInt32(112, true),
    positions: new Float32Array(buffer, HEADER_BYTES, 3 * nodes),
    values: valued ? new Float32Array(buffer, HEADER_BYTES + 12 * nodes, nodes) : null,
    readings: new Float32Array(buffer, afterNodes, 3 * view.getUint32(108, true)),
  };
}
