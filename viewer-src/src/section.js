// The section of tetrahedra by a plane, as triangles with the interpolated value of the nodes.

// For every pattern of corners in front of the plane: edges (pairs of corners) whose crossings make a triangle or, split, a quadrilateral.
const EDGES = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];
const CROSSINGS = Array.from({ length: 16 }, (_, pattern) => {
  const front = [0, 1, 2, 3].filter((k) => pattern & (1 << k));
  const back = [0, 1, 2, 3].filter((k) => !(pattern & (1 << k)));
  const edge = (a, b) => EDGES.findIndex(([p, q]) => p === Math.min(a, b) && q === Math.max(a, b));
  if (front.length === 1) return back.map((k) => edge(front[0], k));
  if (front.length === 3) return front.map((k) => edge(back[0], k));
  if (front.length === 2) {
    const [a, b, c, d] = [edge(front[0], back[0]), edge(front[0], back[1]), edge(front[1], back[1]), edge(front[1], back[0])];
    return [a, b, c, a, c, d];
  }
  return [];
});

/**
 * Triangles of the section of cells (4 m) by the plane normal . x = offset.
 * @returns {{positions: Float32Array, values: Float32Array}} corner after corner
 */
export function section(positions, values, cells, normal, offset) {
  const distance = new Float32Array(positions.length / 3);
  for (let i = 0; i < distance.length; i += 1) {
    distance[i] = normal[0] * positions[3 * i] + normal[1] * positions[3 * i + 1] + normal[2] * positions[3 * i + 2] - offset;
  }
  const points = [];
  const levels = [];
  for (let c = 0; c < cells.length; c += 4) {
    let pattern = 0;
    for (let k = 0; k < 4; k += 1) if (distance[cells[c + k]] > 0) pattern |= 1 << k;
    for (const e of CROSSINGS[pattern]) {
      const [i, j] = EDGES[e].map((k) => cells[c + k]);
      const t = distance[i] / (distance[i] - distance[j]);
      for (let a = 0; a < 3; a += 1) points.push(positions[3 * i + a] + t * (positions[3 * j + a] - positions[3 * i + a]));
      levels.push(values[i] + t * (values[j] - values[i]));
    }
  }
  return { positions: new Float32Array(points), values: new Float32Array(levels) };
}
