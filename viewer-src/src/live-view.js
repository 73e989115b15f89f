// The 3-D view of a running simulation: coloured surface, section, markers, tool, fixtures, and picking.
import {
  BufferAttribute, BufferGeometry, DataTexture, DirectionalLight, DoubleSide, DynamicDrawUsage, FrontSide, HemisphereLight, InstancedMesh,
  LinearFilter, Matrix4, Mesh, MeshBasicMaterial, Plane, Quaternion, Raycaster, Scene, ShaderMaterial, Sphere, SphereGeometry,
  Vector2, Vector3,
} from "three";
import { gridLines } from "./body.js";
import { CutOutline } from "./cut-outline.js";
import { coarserSurface } from "./coarser-surface.js";
import { colourTable, niceCeiling } from "./colormap.js";
import { Detail, STILL_MS, STILL_RATIO } from "./detail.js";
import { cornersOf, FRAGMENT, rigidBody, VERTEX } from "./motion.js";
import { section } from "./section.js";
import { readTheme, View } from "./view.js";

const MARKER_FRACTION = 0.012; // radius of a marker, in radii of the object
const SEEN_PX = 0.05; // motion below this is not drawn
const NEGATIVE = 0.05; // of the largest value, from which on negative ones count
const SEEN_COLOUR = 1 / 512; // nor is a change of a value, of the scale

/** Whether WebGL is drawn by the processor, as where there is no graphics card. */
function drawnBySoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const info = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

export class LiveView extends View {
  /**
   * Where a processor draws, pictures in motion are drawn without smooth edges, which take three times as long, and as finely as there is time
   * for; a picture at rest is drawn once more. A screenshot is drawn anew, so that no frame has to be kept.
   */
  constructor(host) {
    const slow = drawnBySoftware();
    super(host, { antialias: !slow, preserveDrawingBuffer: false });
    this.slow = slow;
  }

  /** Show a decoded scene at rest; one that replaces another, as after a cut, is seen as the other was. */
  show(scene) {
    const [first, clip, marked, mesh] = [!this.scene, this.clip, this.markers?.visible, this.skin?.material.wireframe];
    this.scene = scene;
    this.clear();
    [this.fine, ...(this.coarse?.values() ?? [])].forEach((geometry) => geometry?.dispose()); // those that were not drawn last
    this.world = new Scene();
    this.sun = new DirectionalLight(0xffffff, 1.4);
    this.position = new BufferAttribute(scene.points.slice(), 3).setUsage(DynamicDrawUsage);
    this.level = new BufferAttribute(new Float32Array(scene.points.length / 3), 1).setUsage(DynamicDrawUsage);
    this.top ??= 1;
    this.skin = this.#coloured(this.position, this.level);
    this.whole = new BufferAttribute(scene.faces, 1);
    this.fine = this.skin.geometry;
    this.fine.setIndex(this.whole);
    this.fine.userData.shown = null;
    this.coarse = new Map();
    this.picked = this.#pickable();
    this.drawn = null;
    this.outline = new CutOutline(this.position, scene.outline);
    this.cap = this.#coloured(new BufferAttribute(new Float32Array(0), 3), new BufferAttribute(new Float32Array(0), 1));
    this.cap.visible = false;
    this.#measure();
    this.detail = this.slow ? new Detail(scene.points.length / 3, this.host.clientWidth * this.host.clientHeight) : null;
    this.markers = this.#spheres();
    this.grid = gridLines(scene.points, niceCeiling(this.extent.radius / 6.5));
    this.fixtures = scene.fixtures.filter((f) => f.kind !== "plane").map((f) => this.#fixture(f));
    this.tools = scene.tools.map((t) => rigidBody(t));
    this.tools.forEach((t) => { t.visible = false; });
    this.made = this.tools.map((t) => t.quaternion.clone());
    this.world.add(this.grid, this.skin, ...this.outline.lines, this.cap, this.markers, ...this.fixtures, ...this.tools, new HemisphereLight(0xffffff, 0x8a8a8a, 2.0), this.sun);
    this.applyTheme();
    this.#colours();
    this.#clipBy(clip ?? null);
    this.setMarkers(Boolean(marked) && this.markers.count > 0);
    this.setEdges(Boolean(mesh));
    if (first) this.look("oblique");
  }

  #measure() {
    const { points } = this.scene;
    this.low = [0, 1, 2].map((a) => { let v = Infinity; for (let i = a; i < points.length; i += 3) v = Math.min(v, points[i]); return v; });
    this.high = [0, 1, 2].map((a) => { let v = -Infinity; for (let i = a; i < points.length; i += 3) v = Math.max(v, points[i]); return v; });
    const centre = new Vector3(...this.low).add(new Vector3(...this.high)).multiplyScalar(0.5);
    this.extent = new Sphere(centre, 0.62 * new Vector3(...this.high).distanceTo(new Vector3(...this.low)));
    const above = [...this.high];
    above[2] += 0.35 * (this.high[2] - this.low[2]); // room for the tool
    this.frameful = [[0, 1, 2, 3, 4, 5, 6, 7].flatMap((k) => [0, 1, 2].map((a) => ((k >> a) & 1 ? above[a] : this.low[a])))];
    if (this.waiting) this.frameful.push(...this.waiting);
  }

  /** Make room in the frame for the tools where the first one waits. */
  #makeRoom({ centre, rotation, tool }) {
    const turned = new Quaternion(...rotation);
    const about = new Vector3(...centre);
    this.waiting = this.scene.tools.map((shape, k) => {
      const corners = cornersOf(shape, [0, 0, 0]);
      const at = [];
      for (let i = 0; i < corners.length; i += 3) {
        const p = new Vector3().fromArray(corners, i);
        at.push(...(k === tool ? p.applyQuaternion(turned) : p).add(about).toArray());
      }
      return at;
    });
    this.frameful.push(...this.waiting);
    this.look("oblique");
  }

  #geometry(position, level) {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", position);
    geometry.setAttribute("level", level);
    return geometry;
  }

  #coloured(position, level) {
    const geometry = this.#geometry(position, level);
    const material = new ShaderMaterial({
      vertexShader: `#include <clipping_planes_pars_vertex>\n${VERTEX.replace("gl_Position =", "vec4 mvPosition = p;\n  #include <clipping_planes_vertex>\n  gl_Position =")}`,
      fragmentShader: `#include <clipping_planes_pars_fragment>\n${FRAGMENT.replace("void main() {", "void main() {\n  #include <clipping_planes_fragment>")}`,
      uniforms: { colours: { value: null } },
      side: DoubleSide,
      clipping: true,
      polygonOffset: true, // lines on the surface are seen
      polygonOffsetFactor: 1,
      polygonOffsetUnits: 2,
    });
    const mesh = new Mesh(geometry, material);
    mesh.frustumCulled = false;
    return mesh;
  }

  /** The whole surface, for picking: what is drawn may be coarser. */
  #pickable() {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", this.position);
    geometry.setIndex(this.whole);
    return new Mesh(geometry, new MeshBasicMaterial({ side: DoubleSide }));
  }

  #spheres() {
    const { nodes, each } = this.scene.markers;
    const count = nodes.length / each;
    const ball = new SphereGeometry(MARKER_FRACTION * this.extent.radius, 10, 8);
    const mesh = new InstancedMesh(ball, new MeshBasicMaterial(), Math.max(count, 1));
    mesh.count = count;
    mesh.renderOrder = 2; // behind the tool
    mesh.frustumCulled = false;
    mesh.visible = false;
    return mesh;
  }

  #fixture(fixture) {
    const group = rigidBody(fixture);
    group.position.set(...fixture.centre);
    return group;
  }

  #colours() {
    const texture = new DataTexture(colourTable(false), 256, 1);
    texture.minFilter = texture.magFilter = LinearFilter;
    texture.needsUpdate = true;
    for (const mesh of [this.skin, this.cap]) mesh.material.uniforms.colours.value = texture;
  }

  /** Show a frame, at once; the surface is coloured by displacement, or by the values of the frame if it has some. */
  setFrame(frame) {
    this.frame = frame;
    if (!this.waiting && frame.tool >= 0) this.#makeRoom(frame);
    if (!this.#changed(frame)) return;
    this.drawn = frame;
    this.position.array = frame.positions; // that of the message, not a copy
    this.outline.follow();
    this.tools.forEach((tool, k) => {
      tool.visible = k === frame.tool;
      if (!tool.visible) return;
      tool.position.set(...frame.centre);
      tool.quaternion.set(...frame.rotation).multiply(this.made[k]);
    });
    this.#placeMarkers();
    this.#cut();
    this.render();
  }

  /** Whether a frame looks different from what is drawn. */
  #changed(frame) {
    const { drawn } = this;
    if (!drawn || drawn.tool !== frame.tool || (drawn.values === null) !== (frame.values === null)) return true;
    const least = SEEN_PX * this.mmPerPx;
    if (frame.centre.some((v, a) => Math.abs(v - drawn.centre[a]) > least)) return true;
    if (frame.rotation.some((v, a) => Math.abs(v - drawn.rotation[a]) > 1e-3)) return true;
    const [is, was] = [frame.positions, drawn.positions];
    for (let i = 0; i < is.length; i += 1) if (Math.abs(is[i] - was[i]) > least) return true;
    return frame.values !== null && frame.values.some((v, i) => Math.abs(v - drawn.values[i]) > SEEN_COLOUR * this.top);
  }

  /** Pass on where the nodes of a geometry are, and their colours, unless it has them already. */
  #fill(geometry) {
    const { position, level } = geometry.attributes;
    const { shown, nodes } = geometry.userData;
    if (shown === this.drawn) return;
    geometry.userData.shown = this.drawn;
    const from = this.position.array;
    if (nodes) for (let k = 0; k < nodes.length; k += 1) for (let a = 0; a < 3; a += 1) position.array[3 * k + a] = from[3 * nodes[k] + a];
    position.needsUpdate = level.needsUpdate = true;
    this.#setLevels(from, this.drawn?.values ?? null, level.array, nodes);
  }

  /** Set what the colours stand for, of these nodes or of all of them, and their scale. */
  #setLevels(moved, values, out, nodes) {
    const { points } = this.scene;
    let [largest, smallest] = [0, 0];
    for (let k = 0; k < out.length; k += 1) {
      const i = nodes ? nodes[k] : k;
      let value;
      if (values) value = values[i];
      else {
        const x = moved[3 * i] - points[3 * i];
        const y = moved[3 * i + 1] - points[3 * i + 1];
        const z = moved[3 * i + 2] - points[3 * i + 2];
        value = Math.sqrt(x * x + y * y + z * z); // Math.hypot guards against overflow, and is slow
      }
      out[k] = value;
      if (value > largest) largest = value;
      else if (value < smallest) smallest = value;
    }
    const most = Math.max(largest, -smallest);
    // the scale grows at once and shrinks only when it is three times too long, so that colours do not flicker
    if (most > this.top || most < this.top / 3) this.top = niceCeiling(Math.max(1.1 * most, 0.01));
    // values that are negative, such as elongations, are shown on a scale with zero in its middle
    this.signed = values !== null && (this.signed || -smallest > NEGATIVE * most);
    const [share, zero] = this.signed ? [0.5 / this.top, 0.5] : [1 / this.top, 0];
    for (let k = 0; k < out.length; k += 1) out[k] = zero + out[k] * share;
  }

  /** Draw: where a processor draws, as finely as there is time for, and again when nothing has changed for a while. */
  render() {
    if (!this.detail) {
      this.#fill(this.fine);
      super.render();
      return;
    }
    const { ratio, nodes } = this.detail.level;
    this.#drawAt(ratio, nodes);
    if (this.detail.due) {
      const began = performance.now();
      super.render();
      this.#waitUntilDrawn();
      this.detail.took(performance.now() - began);
    } else super.render();
    clearTimeout(this.rest);
    this.rest = setTimeout(() => this.renderFinest(), STILL_MS);
  }

  /** Draw the picture of a view at rest. */
  renderFinest() {
    if (this.detail) this.#drawAt(STILL_RATIO, Infinity);
    else this.#fill(this.fine);
    super.render();
  }

  #waitUntilDrawn() {
    const gl = this.renderer.getContext();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  }

  /** Set pixels of the canvas for one of the screen, and how many nodes of the surface are drawn. */
  #drawAt(ratio, nodes) {
    if (this.renderer.getPixelRatio() !== ratio) this.renderer.setPixelRatio(ratio);
    // a section, the lines of the mesh and those of cuts belong to the whole surface
    const coarse = nodes < this.position.count && !this.clip && !this.skin.material.wireframe && !this.outline.visible;
    this.skin.geometry = coarse ? this.#coarser(nodes) : this.fine;
    this.#fill(this.skin.geometry);
    // what is behind cannot be seen, and takes time; single triangles of a coarse surface may face the other way
    this.skin.material.side = this.scene.closed && !this.clip && !coarse ? FrontSide : DoubleSide;
  }

  /** The surface between so many nodes, which are passed on to the picture alone: all of them would take as long as drawing these. */
  #coarser(most) {
    if (!this.coarse.has(most)) {
      const faces = coarserSurface(this.scene.points, this.scene.faces, most);
      const nodes = Uint32Array.from(new Set(faces));
      const place = new Map(Array.from(nodes, (node, k) => [node, k]));
      const [position, level] = [3, 1].map((size) => new BufferAttribute(new Float32Array(size * nodes.length), size).setUsage(DynamicDrawUsage));
      const geometry = this.#geometry(position, level);
      geometry.setIndex(new BufferAttribute(faces.map((node) => place.get(node)), 1));
      geometry.userData.nodes = nodes;
      this.coarse.set(most, geometry);
    }
    return this.coarse.get(most);
  }

  #placeMarkers() {
    if (!this.markers.visible) return;
    const { nodes, weights, each } = this.scene.markers;
    const at = this.position.array;
    const places = Array.from({ length: this.markers.count }, (_, q) => {
      const p = new Vector3();
      for (let k = q * each; k < (q + 1) * each; k += 1) p.addScaledVector(new Vector3().fromArray(at, 3 * nodes[k]), weights[k]);
      return p;
    });
    const ahead = this.clip ? places.map((p) => this.clip.distanceToPoint(p)) : [];
    const reach = this.clip ? this.#reach(ahead) : Infinity;
    this.markers.material.depthTest = !this.clip;
    const matrix = new Matrix4();
    places.forEach((p, q) => {
      const hidden = this.clip && Math.abs(ahead[q]) > reach;
      this.markers.setMatrixAt(q, hidden ? matrix.makeScale(0, 0, 0) : matrix.makeTranslation(p));
    });
    this.markers.instanceMatrix.needsUpdate = true;
  }

  /**
   * How far from a section, which is opaque, markers are seen on it, on either side: half their mean distance, and where it passes between
   * them, as between the layers in which they were laid, as far as the nearest ones.
   */
  #reach(ahead) {
    const box = this.high.map((v, a) => v - this.low[a]);
    const half = 0.5 * Math.cbrt((box[0] * box[1] * box[2]) / Math.max(ahead.length, 1));
    const [before, behind] = [1, -1].map((sign) => Math.min(...ahead.filter((v) => sign * v >= 0).map(Math.abs))); // Infinity: none
    return Number.isFinite(before + behind) ? Math.max(half, Math.min(before, behind) + 0.5 * half) : half;
  }

  /** Cut the view by a plane across axis 0, 1 or 2 at a fraction of the object's extent; null shows everything. */
  setClip(axis, fraction = 0.5) {
    if (axis === null) {
      this.#clipBy(null);
      return;
    }
    const normal = [0, 0, 0];
    normal[axis] = axis === 1 ? 1 : -1; // the half that faces the usual view is taken away
    const at = this.low[axis] + fraction * (this.high[axis] - this.low[axis]);
    this.#clipBy(new Plane(new Vector3(...normal), -normal[axis] * at));
  }

  #clipBy(plane) {
    this.clip = plane;
    this.renderer.localClippingEnabled = Boolean(this.clip);
    for (const { material } of [this.skin, ...this.outline.lines]) material.clippingPlanes = this.clip ? [this.clip] : [];
    this.cap.visible = Boolean(this.clip);
    this.#cut();
    this.#placeMarkers();
    this.requestRender();
  }

  #cut() {
    if (!this.clip) return;
    this.#fill(this.fine);
    const { normal, constant } = this.clip;
    const found = section(this.position.array, this.level.array, this.scene.cells, [normal.x, normal.y, normal.z], -constant);
    const { geometry } = this.cap;
    geometry.setAttribute("position", new BufferAttribute(found.positions, 3));
    geometry.setAttribute("level", new BufferAttribute(found.values, 1));
  }

  setMarkers(on) {
    this.markers.visible = on;
    this.#placeMarkers();
    this.requestRender();
  }

  setEdges(on) {
    this.skin.material.wireframe = on;
    this.requestRender();
  }

  #ray(x, y) {
    const box = this.canvas.getBoundingClientRect();
    const ray = new Raycaster();
    ray.setFromCamera(new Vector2((2 * (x - box.left)) / box.width - 1, 1 - (2 * (y - box.top)) / box.height), this.camera);
    return ray;
  }

  /** Node of the surface under the pointer, and the point that was hit; null beside the object. */
  pick(x, y) {
    this.picked.geometry.computeBoundingSphere();
    const hits = this.#ray(x, y).intersectObject(this.picked);
    const hit = hits.find(({ point }) => !this.clip || this.clip.distanceToPoint(point) >= 0);
    if (!hit) return null;
    const corners = [hit.face.a, hit.face.b, hit.face.c];
    const at = new Vector3();
    const distances = corners.map((k) => at.fromBufferAttribute(this.position, k).distanceTo(hit.point));
    return { node: corners[distances.indexOf(Math.min(...distances))], point: hit.point };
  }

  /** Whether the pointer is on the tool in play. */
  onTool(x, y) {
    const tool = this.tools[this.frame?.tool ?? -1];
    return Boolean(tool) && this.#ray(x, y).intersectObject(tool, true).length > 0;
  }

  /** The point under the pointer on the plane through `through` that faces the camera. */
  inViewPlane(x, y, through) {
    const facing = new Plane().setFromNormalAndCoplanarPoint(this.camera.getWorldDirection(new Vector3()), new Vector3(...through));
    const point = this.#ray(x, y).ray.intersectPlane(facing, new Vector3());
    return point ? [point.x, point.y, point.z] : null;
  }

  /** The edge of a blade that reaches through the object under the pointer: a point before it and one behind. */
  edgeThrough(x, y) {
    const { origin, direction } = this.#ray(x, y).ray;
    const depth = this.extent.center.clone().sub(origin).dot(direction);
    return [-1, 1].map((sign) => origin.clone().addScaledVector(direction, depth + sign * 1.5 * this.extent.radius).toArray());
  }

  /** Unit vectors of the screen: to the right, upwards, and away from the viewer. */
  screenAxes() {
    const [right, up] = [0, 1].map((k) => new Vector3().setFromMatrixColumn(this.camera.matrixWorld, k).toArray());
    return { right, up, away: this.camera.getWorldDirection(new Vector3()).toArray() };
  }

  applyTheme() {
    const colours = readTheme(this.host);
    this.world.background = null;
    this.renderer.setClearColor(colours.background);
    this.grid.material.color.set(colours.grid);
    this.markers.material.color.set(colours.predicted);
    for (const group of [...this.tools, ...this.fixtures]) group.children.forEach((part) => part.material.color.set(colours.box));
    this.requestRender();
  }
}

