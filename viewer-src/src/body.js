// The soft body: translucent skin, its sharp edges, the undeformed outline, the indenters and the grid below.
import {
  BoxGeometry, BufferAttribute, BufferGeometry, Color, DoubleSide, EdgesGeometry, Group, LineBasicMaterial, LineDashedMaterial,
  LineSegments, Mesh, MeshBasicMaterial, ShaderMaterial, Vector3,
} from "three";

const SKIN_VERTEX = `
varying vec3 seen;
void main() {
  vec4 p = modelViewMatrix * vec4(position, 1.0);
  seen = p.xyz;
  gl_Position = projectionMatrix * p;
}`;

// More opaque where the skin is seen edge-on, so that the rounding shows although it is translucent.
const SKIN_FRAGMENT = `
uniform vec3 colour;
uniform float opacity;
varying vec3 seen;
void main() {
  vec3 n = normalize(cross(dFdx(seen), dFdy(seen)));
  float edgeOn = 1.0 - abs(n.z);
  gl_FragColor = vec4(colour * (0.82 + 0.18 * abs(n.y)), opacity * (0.55 + 1.6 * edgeOn * edgeOn));
}`;

/** Node pairs of sharp edges: the normals of two faces differ by more than `degrees`, or the edge belongs to one face only. */
export function sharpEdges(points, faces, degrees) {
  const limit = Math.cos((degrees * Math.PI) / 180);
  const seen = new Map();
  const [a, b, c] = [new Vector3(), new Vector3(), new Vector3()];
  for (let f = 0; f < faces.length; f += 3) {
    a.fromArray(points, 3 * faces[f]);
    b.fromArray(points, 3 * faces[f + 1]).sub(a);
    c.fromArray(points, 3 * faces[f + 2]).sub(a);
    const normal = new Vector3().crossVectors(b, c).normalize();
    for (let k = 0; k < 3; k += 1) {
      const pair = [faces[f + k], faces[f + ((k + 1) % 3)]].sort((p, q) => p - q);
      const entry = seen.get(pair.join());
      if (entry) entry.normals.push(normal);
      else seen.set(pair.join(), { pair, normals: [normal] });
    }
  }
  const sharp = [...seen.values()].filter(({ normals }) => normals.length !== 2 || normals[0].dot(normals[1]) < limit);
  return new Uint32Array(sharp.flatMap(({ pair }) => pair));
}

export function lines(points, index, material) {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", points);
  geometry.setIndex(new BufferAttribute(index, 1));
  const out = new LineSegments(geometry, material);
  out.frustumCulled = false;
  return out;
}

export function gridLines(reference, spacing) {
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity];
  for (let i = 0; i < reference.length; i += 1) {
    low[i % 3] = Math.min(low[i % 3], reference[i]);
    if (i % 3 < 2) high[i % 3] = Math.max(high[i % 3], reference[i]);
  }
  const from = [0, 1].map((k) => spacing * (Math.floor(low[k] / spacing) - 1));
  const to = [0, 1].map((k) => spacing * (Math.ceil(high[k] / spacing) + 1));
  const floor = low[2] - 0.02 * spacing; // not in the lowest part of an open surface, which it would shine through
  const points = [];
  for (let x = from[0]; x <= to[0] + 1e-6; x += spacing) points.push(x, from[1], floor, x, to[1], floor);
  for (let y = from[1]; y <= to[1] + 1e-6; y += spacing) points.push(from[0], y, floor, to[0], y, floor);
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(points), 3));
  return new LineSegments(geometry, new LineBasicMaterial());
}

export class Body {
  constructor(scene, gridSpacing) {
    this.position = new BufferAttribute(new Float32Array(scene.reference), 3);
    this.skin = this.#skin(scene.faces);
    const edges = sharpEdges(scene.reference, scene.faces, 35);
    this.edges = lines(this.position, edges, new LineBasicMaterial());
    this.reference = lines(new BufferAttribute(scene.reference, 3), edges, new LineDashedMaterial({ dashSize: 2, gapSize: 1.5 }));
    this.reference.geometry = this.reference.geometry.toNonIndexed();
    this.reference.computeLineDistances();
    this.grid = gridLines(scene.reference, gridSpacing);
    this.boxes = new Group();
    const count = Math.max(...scene.steps.map((s) => s.boxes.length));
    for (let i = 0; i < count; i += 1) this.boxes.add(this.#box());
    this.objects = [this.grid, this.reference, this.edges, this.skin, this.boxes];
  }

  #skin(faces) {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", this.position);
    geometry.setIndex(new BufferAttribute(faces, 1));
    const material = new ShaderMaterial({
      vertexShader: SKIN_VERTEX,
      fragmentShader: SKIN_FRAGMENT,
      uniforms: { colour: { value: new Vector3() }, opacity: { value: 0.2 } },
      transparent: true,
      depthWrite: false,
      side: DoubleSide,
    });
    const mesh = new Mesh(geometry, material);
    mesh.frustumCulled = false;
    mesh.renderOrder = 2;
    return mesh;
  }

  #box() {
    const group = new Group();
    const unit = new BoxGeometry(2, 2, 2);
    const fill = new Mesh(unit, new MeshBasicMaterial({ transparent: true, opacity: 0.1, depthWrite: false, side: DoubleSide }));
    fill.renderOrder = 3;
    group.add(fill, new LineSegments(new EdgesGeometry(unit), new LineBasicMaterial()));
    return group;
  }

  /** Between steps `a` and `b` at fraction `t`. */
  blend(a, b, t) {
    const out = this.position.array;
    for (let i = 0; i < out.length; i += 1) out[i] = a.surface[i] + t * (b.surface[i] - a.surface[i]);
    this.position.needsUpdate = true;
    this.boxes.children.forEach((box, i) => {
      const from = a.boxes[i];
      const to = b.boxes[i] ?? from;
      box.visible = Boolean(from);
      if (!from) return;
      const mixed = from.map((v, k) => v + t * (to[k] - v));
      box.position.fromArray(mixed, 0);
      box.scale.fromArray(mixed, 3);
      box.quaternion.fromArray(mixed, 6).normalize();
    });
  }

  paint(colours) {
    const skin = new Color(colours.skin).convertLinearToSRGB();
    this.skin.material.uniforms.colour.value.set(skin.r, skin.g, skin.b);
    this.skin.material.uniforms.opacity.value = colours.skinOpacity;
    this.edges.material.color.set(colours.edge);
    this.reference.material.color.set(colours.reference);
    this.grid.material.color.set(colours.grid);
    for (const box of this.boxes.children) box.children.forEach((part) => part.material.color.set(colours.box));
  }
}
