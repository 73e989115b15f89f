// A surface with fewer triangles for pictures that must be quick: vertex clustering (Rossignac and Borrel 1993).

/** Length of the edge of a cell for about `most` cells that the surface passes through, mm. */
function cellSize(points, faces, most) {
  let area = 0;
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [3 * faces[f], 3 * faces[f + 1], 3 * faces[f + 2]];
    const [ux, uy, uz] = [points[b] - points[a], points[b + 1] - points[a + 1], points[b + 2] - points[a + 2]];
    const [vx, vy, vz] = [points[c] - points[a], points[c + 1] - points[a + 1], points[c + 2] - points[a + 2]];
    area += 0.5 * Math.hypot(uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx);
  }
  return Math.sqrt((1.5 * area) / most); // a plane that lies obliquely passes through up to sqrt(3) cells for each square of their edge
}

/** The node that stands for each node: the one of its cell that is nearest to the middle of the cell's nodes. */
function representatives(points, faces, size) {
  const cells = new Map();
  const cellOf = new Map();
  for (const node of new Set(faces)) {
    const [i, j, k] = [0, 1, 2].map((a) => Math.floor(points[3 * node + a] / size) + 1_000);
    const key = i + 2_000 * (j + 2_000 * k);
    if (!cells.has(key)) cells.set(key, { nodes: [], sum: [0, 0, 0] });
    const cell = cells.get(key);
    cell.nodes.push(node);
    for (let a = 0; a < 3; a += 1) cell.sum[a] += points[3 * node + a];
    cellOf.set(node, cell);
  }
  for (const cell of cells.values()) {
    const middle = cell.sum.map((v) => v / cell.nodes.length);
    const away = (node) => (points[3 * node] - middle[0]) ** 2 + (points[3 * node + 1] - middle[1]) ** 2 + (points[3 * node + 2] - middle[2]) ** 2;
    cell.node = cell.nodes.reduce((best, node) => (away(node) < away(best) ? node : best));
  }
  return (node) => cellOf.get(node).node;
}

/**
 * Triangles between about `most` of the nodes, which lie where the body's nodes lie.
 * @param {Float32Array} points nodes (3 n), at rest
 * @param {Uint32Array} faces triangles (3 m)
 * @param {number} most nodes that may remain
 * @returns {Uint32Array} triangles (3 k)
 */
export function coarserSurface(points, faces, most) {
  const of = representatives(points, faces, cellSize(points, faces, most));
  const out = [];
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [of(faces[f]), of(faces[f + 1]), of(faces[f + 2])];
    if (a !== b && b !== c && c !== a) out.push(a, b, c);
  }
  return new Uint32Array(out);
}
