// Where cuts meet the surface, also while they are closed: a dark line in a light one, which is seen on every colour of the scale.
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";

const STROKES = [{ color: 0xffffff, linewidth: 5 }, { color: 0x000000, linewidth: 2 }]; // pixels of the screen
const NEARER = -4000; // steps of the depth, some thousandths of the body, so that a slanting surface does not hide half the width

const OVER = { clipping: true, depthWrite: false, polygonOffset: true, polygonOffsetFactor: 0, polygonOffsetUnits: NEARER };

export class CutOutline {
  /** @param position attribute of the nodes, which moves; @param {Uint32Array} edges pairs of nodes */
  constructor(position, edges) {
    this.position = position;
    this.edges = edges;
    this.visible = edges.length > 0;
    this.geometry = new LineSegmentsGeometry();
    this.geometry.setPositions(new Float32Array(3 * Math.max(edges.length, 2)));
    this.lines = STROKES.map((stroke, k) => {
      const lines = new LineSegments2(this.geometry, new LineMaterial({ ...stroke, ...OVER }));
      lines.renderOrder = k + 1; // after the surface, the dark one last
      lines.frustumCulled = false;
      lines.visible = this.visible;
      return lines;
    });
    this.follow();
  }

  /** Draw the lines where the nodes are now. */
  follow() {
    if (!this.visible) return;
    const from = this.position.array;
    const { data } = this.geometry.attributes.instanceStart;
    this.edges.forEach((node, k) => {
      for (let a = 0; a < 3; a += 1) data.array[3 * k + a] = from[3 * node + a];
    });
    data.needsUpdate = true;
  }
}
