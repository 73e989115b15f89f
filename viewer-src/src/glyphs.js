// Marker glyphs and arrows as instanced meshes.
import {
  BufferAttribute, BufferGeometry, Color, ConeGeometry, CylinderGeometry, InstancedMesh, Matrix4, MeshBasicMaterial,
  MeshLambertMaterial, Quaternion, SphereGeometry, SRGBColorSpace, Vector3,
} from "three";

const UP = new Vector3(0, 1, 0);
const HIDDEN = new Matrix4().makeScale(0, 0, 0);

/** The twelve edges of an octahedron of radius 1 as thin three-sided bars: a cage that leaves the measured sphere visible. */
function cageGeometry(thickness) {
  const corners = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]].map((c) => new Vector3(...c));
  const positions = [];
  for (let i = 0; i < 6; i += 1) {
    for (let j = i + 1; j < 6; j += 1) {
      if (corners[i].dot(corners[j]) === 0) positions.push(...barTriangles(corners[i], corners[j], thickness));
    }
  }
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(positions), 3));
  geometry.computeVertexNormals();
  return geometry;
}

function barTriangles(a, b, thickness) {
  const along = new Vector3().subVectors(b, a).normalize();
  const side = new Vector3().crossVectors(along, Math.abs(along.z) < 0.9 ? new Vector3(0, 0, 1) : new Vector3(1, 0, 0)).normalize();
  const other = new Vector3().crossVectors(along, side);
  const ring = [0, 1, 2].map((k) => {
    const angle = (2 * Math.PI * k) / 3;
    return side.clone().multiplyScalar(thickness * Math.cos(angle)).addScaledVector(other, thickness * Math.sin(angle));
  });
  const out = [];
  for (let k = 0; k < 3; k += 1) {
    const [p, q] = [ring[k], ring[(k + 1) % 3]];
    const quad = [[a, p], [a, q], [b, p], [a, q], [b, q], [b, p]];
    for (const [end, offset] of quad) out.push(end.x + offset.x, end.y + offset.y, end.z + offset.z);
  }
  return out;
}

function instanced(geometry, material, count) {
  const mesh = new InstancedMesh(geometry, material, count);
  mesh.frustumCulled = false;
  return mesh;
}

export function measuredGlyphs(count) {
  return instanced(new SphereGeometry(1, 14, 10), new MeshLambertMaterial({ transparent: true }), count);
}

export function predictedGlyphs(count) {
  return instanced(cageGeometry(0.09), new MeshLambertMaterial(), count);
}

/** Move glyph i to points[3i..3i+2]; a NaN coordinate hides it. */
export function setPositions(mesh, points, radius) {
  const matrix = new Matrix4();
  for (let i = 0; i < mesh.count; i += 1) {
    const [x, y, z] = [points[3 * i], points[3 * i + 1], points[3 * i + 2]];
    mesh.setMatrixAt(i, Number.isFinite(x + y + z) ? matrix.makeScale(radius, radius, radius).setPosition(x, y, z) : HIDDEN);
  }
  mesh.instanceMatrix.needsUpdate = true;
}

/** Arrows: one instanced shaft and one instanced head per marker. */
export class Arrows {
  constructor(count) {
    this.shafts = instanced(new CylinderGeometry(1, 1, 1, 8).translate(0, 0.5, 0), new MeshBasicMaterial(), count);
    this.heads = instanced(new ConeGeometry(1, 1, 12).translate(0, 0.5, 0), new MeshBasicMaterial(), count);
    this.meshes = [this.shafts, this.heads];
  }

  /** Arrow i starts at starts[3i..] and is vectors[3i..] times `factor`; its line has radius `radius` mm. */
  setVectors(starts, vectors, factor, radius) {
    const at = new Vector3();
    const v = new Vector3();
    const turn = new Quaternion();
    const matrix = new Matrix4();
    for (let i = 0; i < this.shafts.count; i += 1) {
      at.fromArray(starts, 3 * i);
      v.fromArray(vectors, 3 * i).multiplyScalar(factor);
      const length = v.length();
      if (!(length > 1e-6)) {
        this.meshes.forEach((mesh) => mesh.setMatrixAt(i, HIDDEN));
        continue;
      }
      const head = Math.min(0.5 * length, 5.5 * radius);
      turn.setFromUnitVectors(UP, v.clone().divideScalar(length));
      this.shafts.setMatrixAt(i, matrix.compose(at, turn, new Vector3(radius, length - head, radius)));
      at.addScaledVector(v, (length - head) / length);
      this.heads.setMatrixAt(i, matrix.compose(at, turn, new Vector3(0.45 * head, head, 0.45 * head)));
    }
    this.meshes.forEach((mesh) => { mesh.instanceMatrix.needsUpdate = true; });
  }

  /** Colour arrow i with `colourOf(i)`, an sRGB triple. */
  paint(colourOf) {
    const colour = new Color();
    for (let i = 0; i < this.shafts.count; i += 1) {
      colour.setRGB(...colourOf(i), SRGBColorSpace);
      this.meshes.forEach((mesh) => mesh.setColorAt(i, colour));
    }
    this.meshes.forEach((mesh) => { mesh.instanceColor.needsUpdate = true; });
  }

  set visible(on) {
    this.meshes.forEach((mesh) => { mesh.visible = on; });
  }
}
