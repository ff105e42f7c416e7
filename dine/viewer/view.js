// The viewer of view.html: source, target and moved source with three.js, from the JSON in #data.
"use strict";
(() => {
  const get = (id) => document.getElementById(id);
  const data = JSON.parse(get("data").textContent);
  const canvas = get("stage");
  const NO_VALUE = [0.36, 0.37, 0.39]; // linear light: darker than the background

  function stop(message) {
    get("problem").hidden = false;
    get("problem").firstElementChild.textContent = message;
    get("controls").hidden = true;
  }

  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
  } catch {
    stop(
      "This browser offers no 3D graphics (WebGL 2), so the shapes cannot be drawn. Switch on " +
        "hardware acceleration, or open this file in a current Firefox, Chromium or Safari."
    );
    return;
  }
  canvas.addEventListener("webglcontextlost", () =>
    stop("The graphics card stopped drawing. Reload this page to go on.")
  );

  // --- data ---------------------------------------------------------------------------------

  function decode({ type, base64 }) {
    const text = atob(base64);
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    const Type = { float32: Float32Array, uint32: Uint32Array, uint16: Uint16Array }[type];
    return new Type(bytes.buffer);
  }

  const ramp = data.colormap.map((hex) => new THREE.Color(hex).toArray()); // linear light

  /** (3 V) vertex colours of values between low and high; grey where there is no number. */
  function colorsOf({ values, low, high }) {
    const colors = new Float32Array(3 * values.length);
    const scale = (ramp.length - 1) / (high - low || 1);
    for (let i = 0; i < values.length; i++) {
      const place = Math.min(Math.max((values[i] - low) * scale, 0), ramp.length - 1);
      colors.set(Number.isNaN(place) ? NO_VALUE : ramp[Math.round(place)], 3 * i);
    }
    return colors;
  }

  function geometryOf(positions, faces) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
    if (faces) {
      geometry.setIndex(new THREE.BufferAttribute(faces, 1));
      geometry.computeVertexNormals();
    }
    return geometry;
  }

  const source = decode(data.source.positions);
  const result = decode(data.result);
  const sourceFaces = data.source.faces && decode(data.source.faces);
  const targetFaces = data.target.faces && decode(data.target.faces);
  const rows = data.source.rows && decode(data.source.rows); // where a mesh is shown in part
  const scalars = data.scalars.map((scalar) => ({ ...scalar, values: decode(scalar.values) }));

  let stale = true;
  function draw() {
    stale = true;
  }

  // --- scene --------------------------------------------------------------------------------

  const scene = new THREE.Scene();
  // Without perspective, so that lengths compare and the scale bar holds at any depth. Its frame is
  // in pixels: zoom is pixels per radius of all shapes.
  const camera = new THREE.OrthographicCamera(-1, 1, 1, -1, 0.01, 40);

  /** A small ball in light grey, which colours tint: it gives points some depth. */
  function ballTexture() {
    const ball = document.createElement("canvas");
    ball.width = ball.height = 64;
    const context = ball.getContext("2d");
    const shade = context.createRadialGradient(25, 22, 2, 32, 32, 32);
    shade.addColorStop(0, "#fff");
    shade.addColorStop(0.55, "#eee");
    shade.addColorStop(1, "#999");
    context.fillStyle = shade;
    context.arc(32, 32, 31, 0, 2 * Math.PI);
    context.fill();
    const texture = new THREE.CanvasTexture(ball);
    texture.colorSpace = THREE.SRGBColorSpace;
    return texture;
  }

  const ball = ballTexture();

  /** A surface where there are faces, a cloud of round points where there are none. */
  function shapeOf(geometry, color) {
    if (!geometry.index) {
      const material = new THREE.PointsMaterial({ color, map: ball });
      return new THREE.Points(geometry, material);
    }
    const material = new THREE.MeshPhongMaterial({
      color, side: THREE.DoubleSide, specular: 0x262626, shininess: 20,
    });
    // A see-through surface is clear where it faces the viewer and denser towards its outline, so
    // that it does not veil the colours of the one inside or speckle where the two coincide.
    material.onBeforeCompile = (shader) => {
      shader.fragmentShader = shader.fragmentShader.replace(
        "#include <opaque_fragment>",
        `#ifdef SEE_THROUGH
          float facing = abs(normal.z);
          float rim = pow(1.0 - facing, 1.5);
          diffuseColor.a = mix(opacity * opacity, min(1.0, 1.8 * opacity), rim);
        #endif
        #include <opaque_fragment>`
      );
    };
    return new THREE.Mesh(geometry, material);
  }

  /** Opacity 0 to 1, and whether a mesh is drawn by its lines. */
  function setStyle(shape, opacity, lines) {
    const { material } = shape;
    const seeThrough = opacity < 1;
    material.opacity = opacity;
    material.wireframe = lines;
    material.transparent = seeThrough;
    material.alphaToCoverage = Boolean(material.map) && !seeThrough; // it would make points opaque
    material.depthWrite = !seeThrough;
    // Where shapes coincide, lines are in front of opaque surfaces, these of see-through ones.
    material.polygonOffset = !lines;
    material.polygonOffsetFactor = material.polygonOffsetUnits = seeThrough ? 3 : 1;
    material.alphaTest = material.map ? 0.5 * opacity : 0;
    material.defines = seeThrough && !lines ? { SEE_THROUGH: "" } : {};
    material.needsUpdate = true;
    shape.renderOrder = seeThrough ? 1 : 0;
  }

  scene.add(camera, new THREE.HemisphereLight(0xffffff, 0xd5dbe2, 2.1));
  const light = new THREE.DirectionalLight(0xffffff, 1.7);
  light.position.set(-0.5, 0.8, 1);
  camera.add(light);
  camera.add(light.target);
  light.target.position.set(0, 0, -1);

  /** A geometry that goes from one place to another. */
  function movingOf(from, to, faces) {
    const geometry = geometryOf(from, faces);
    const end = geometryOf(to, faces);
    geometry.morphAttributes.position = [end.attributes.position];
    if (faces) geometry.morphAttributes.normal = [end.attributes.normal];
    return geometry;
  }

  const moving = movingOf(source, result, sourceFaces);
  const geometries = {
    moved: moving,
    target: geometryOf(decode(data.target.positions), targetFaces),
    source: geometryOf(source, sourceFaces),
  };
  const pointSizes = {
    moved: data.source.pointSize, target: data.target.pointSize, source: data.source.pointSize,
  };
  for (const [id, { positions, result, faces, pointSize }] of Object.entries(data.further)) {
    geometries[id] = movingOf(decode(positions), decode(result), faces && decode(faces));
    pointSizes[id] = pointSize;
  }
  const layers = {};
  for (const { id, color, opacity, shown, mesh, lines } of data.layers) {
    const shape = shapeOf(geometries[id], color);
    shape.userData.pointSize = pointSizes[id];
    shape.visible = shown;
    layers[id] = shape;
    scene.add(shape);
    const style = { opacity: opacity / 100, lines };
    const restyle = () => {
      setStyle(shape, style.opacity, style.lines);
      draw();
    };
    setStyle(shape, style.opacity, lines);
    get(`show-${id}`).addEventListener("change", (event) => {
      shape.visible = event.target.checked;
      draw();
    });
    get(`opacity-${id}`).addEventListener("input", (event) => {
      style.opacity = event.target.value / 100;
      restyle();
    });
    if (!mesh) continue;
    get(`lines-${id}`).addEventListener("click", (event) => {
      style.lines = !style.lines;
      event.target.setAttribute("aria-pressed", style.lines);
      restyle();
    });
  }
  const moved = layers.moved;
  const plain = moved.material.color.clone();
  const movers = [moved, ...Object.keys(data.further).map((id) => layers[id])];
  for (const shape of movers) shape.updateMorphTargets();

  // --- colours ------------------------------------------------------------------------------

  const minus = (text) => text.replaceAll("-", "−");
  const digits = (value) => minus(String(Number(value.toPrecision(3))));
  const withUnit = (value, unit) => (unit ? `${digits(value)} ${unit}` : digits(value));

  const RAMP = `linear-gradient(to right, ${data.colormap.join(",")})`;
  let coloured = null; // the scalar that is shown

  function colorBy(index) {
    const chosen = (coloured = scalars[index] || null);
    const { material } = moved;
    material.vertexColors = chosen !== null;
    material.color.copy(plain);
    if (chosen) {
      material.color.set(0xffffff);
      moving.setAttribute("color", new THREE.BufferAttribute(colorsOf(chosen), 3));
    }
    material.needsUpdate = true;
    get("swatch-moved").style.background = chosen ? RAMP : data.layers[0].color;
    get("note").textContent = chosen ? about(chosen) : "";
    draw();
  }

  function about({ over, missing, mean, largest, unit, explained }) {
    const notes = [];
    if (mean !== null) notes.push(`Mean ${digits(mean)}, largest ${withUnit(largest, unit)}.`);
    if (over > 0) notes.push(`${over} points are above the scale.`);
    if (missing > 0) notes.push(`Grey: ${missing} points without a value.`);
    return [explained, ...notes].filter(Boolean).join(" ");
  }

  if (scalars.length) {
    get("scalar").addEventListener("change", (event) => colorBy(Number(event.target.value)));
  }

  // --- motion -------------------------------------------------------------------------------

  const morph = get("morph");
  let playing = null;

  function moveTo(share) {
    for (const shape of movers) shape.morphTargetInfluences[0] = share;
    morph.value = Math.round(1000 * share);
    get("share").textContent = `${Math.round(100 * share)} %`;
    morph.setAttribute("aria-valuetext", `${Math.round(100 * share)} percent of the motion`);
    draw();
  }

  function play(on) {
    get("play").textContent = on ? "Pause" : "Play";
    playing = on ? performance.now() - 1000 * timeOf(morph.value / 1000) : null;
  }

  // One round trip takes 4 s, slow at both ends: share = (1 - cos(pi t / 2)) / 2.
  const timeOf = (share) => (2 / Math.PI) * Math.acos(1 - 2 * share);

  morph.addEventListener("input", () => {
    play(false);
    moveTo(morph.value / 1000);
  });
  get("play").addEventListener("click", () => play(playing === null));

  // --- camera -------------------------------------------------------------------------------

  const controls = new THREE.TrackballControls(camera, canvas);
  controls.rotateSpeed = 3;
  controls.zoomSpeed = 1.2;
  controls.staticMoving = true;
  controls.keys = [];
  const DISTANCE = 20; // all shapes together have radius 1 and their middle at 0
  const MARGIN = [24, 76]; // pixels beside the shapes, and above and below them for the scales
  let untouched = true; // the first view stays fitted when the window changes

  /** Half the extent of all that is drawn, along two unit vectors. */
  function extent(right, up) {
    const most = [1e-3, 1e-3];
    for (const points of [source, result, geometries.target.attributes.position.array]) {
      for (let i = 0; i < points.length; i += 3) {
        const [x, y, z] = [points[i], points[i + 1], points[i + 2]];
        if (x * x + y * y + z * z > 1.001) continue; // no face uses it
        [right, up].forEach((axis, k) => {
          most[k] = Math.max(most[k], Math.abs(x * axis.x + y * axis.y + z * axis.z));
        });
      }
    }
    return most;
  }

  /** Look at the middle from a direction, with everything in the picture. */
  function lookFrom({ direction, up }) {
    const [eye, top] = [new THREE.Vector3(...direction), new THREE.Vector3(...up)];
    const [wide, high] = extent(new THREE.Vector3().crossVectors(top, eye), top);
    controls.reset();
    controls.target.set(0, 0, 0);
    camera.position.copy(eye).multiplyScalar(DISTANCE);
    camera.up.copy(top);
    camera.zoom = Math.max(
      Math.min(camera.right / wide, camera.top / high) / 4, // where margins leave nothing
      Math.min((camera.right - MARGIN[0]) / wide, (camera.top - MARGIN[1]) / high)
    );
    controls.minZoom = camera.zoom / 10;
    controls.maxZoom = camera.zoom * 200;
    camera.updateProjectionMatrix();
    controls.update();
    draw();
  }

  function reset() {
    lookFrom(data.view);
    untouched = true;
  }
  for (const button of document.querySelectorAll("[data-side]")) {
    button.addEventListener("click", () => {
      untouched = false;
      lookFrom(data.sides[button.dataset.side]);
    });
  }
  get("reset").addEventListener("click", reset);
  for (const event of ["pointerdown", "wheel"]) {
    canvas.addEventListener(event, () => (untouched = false));
  }

  function turn(right, up) {
    const eye = camera.position.clone().sub(controls.target);
    const side = new THREE.Vector3().crossVectors(camera.up, eye).normalize();
    eye.applyAxisAngle(camera.up.clone().normalize(), right).applyAxisAngle(side, -up);
    camera.up.applyAxisAngle(side, -up);
    camera.position.copy(controls.target).add(eye);
  }

  function shift(right, up) {
    const eye = camera.position.clone().sub(controls.target);
    const side = new THREE.Vector3().crossVectors(camera.up, eye).normalize();
    const step = side.multiplyScalar(right).addScaledVector(camera.up.clone().normalize(), up);
    step.multiplyScalar((2 * camera.top) / camera.zoom);
    camera.position.add(step);
    controls.target.add(step);
  }

  function zoom(factor) {
    camera.zoom = Math.min(Math.max(camera.zoom * factor, controls.minZoom), controls.maxZoom);
    camera.updateProjectionMatrix();
  }

  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const arrow = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[
      event.key
    ];
    if (arrow && event.shiftKey) shift(-0.03 * arrow[0], -0.03 * arrow[1]);
    else if (arrow) turn(-0.12 * arrow[0], -0.12 * arrow[1]);
    else if (event.key === "+" || event.key === "=") zoom(1 / 0.9);
    else if (event.key === "-" || event.key === "_") zoom(0.9);
    else if (event.key !== "0") return;
    event.preventDefault();
    untouched = false;
    if (event.key === "0") reset();
    draw();
  });

  // --- values at a click --------------------------------------------------------------------

  const place = new THREE.Vector3();

  /** Where a vertex of the moved source is on the canvas: x, y in pixels, depth in z. */
  function onScreen(vertex) {
    const share = moved.morphTargetInfluences[0];
    const at = (k) => source[3 * vertex + k] + share * (result[3 * vertex + k] - source[3 * vertex + k]);
    place.set(at(0), at(1), at(2)).project(camera);
    place.x = (1 + place.x) * camera.right;
    place.y = (1 - place.y) * camera.top;
    return place;
  }

  /** The vertex of the moved source at a place of the canvas, or -1. */
  function pick(x, y) {
    if (!moved.visible) return -1;
    camera.updateMatrixWorld();
    const distance = (vertex) => {
      const at = onScreen(vertex);
      return Math.hypot(at.x - x, at.y - y);
    };
    if (sourceFaces) {
      const ray = new THREE.Raycaster();
      ray.setFromCamera(new THREE.Vector2(x / camera.right - 1, 1 - y / camera.top), camera);
      const hit = ray.intersectObject(moved)[0];
      if (!hit) return -1;
      const corners = [hit.face.a, hit.face.b, hit.face.c];
      return corners.reduce((best, corner) => (distance(corner) < distance(best) ? corner : best));
    }
    let [best, depth] = [-1, Infinity];
    for (let vertex = 0; vertex < source.length / 3; vertex++) {
      const off = distance(vertex);
      // Behind by a little is better than beside: the nearest pixel counts as depth, too.
      if (off < 12 && place.z + 1e-4 * off < depth) {
        [best, depth] = [vertex, place.z + 1e-4 * off];
      }
    }
    return best;
  }

  let pressed = null;
  let picked = -1;
  canvas.addEventListener("pointerdown", (event) => {
    pressed = [event.clientX, event.clientY];
  });
  canvas.addEventListener("pointerup", (event) => {
    const steady = event.pointerType === "mouse" ? 3 : 10; // pixels that a click may waver
    if (!pressed || Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > steady) return;
    const box = canvas.getBoundingClientRect();
    picked = pick(event.clientX - box.left, event.clientY - box.top);
    get("readout").textContent = picked < 0 ? "" : describe(picked);
    draw();
  });

  function describe(vertex) {
    // To a thousandth of the radius, wherever the object lies.
    const decimals = Math.min(Math.max(0, 3 - Math.floor(Math.log10(data.radius))), 20);
    const end = data.centre.map((middle, axis) => {
      return minus((middle + data.radius * result[3 * vertex + axis]).toFixed(decimals));
    });
    const lines = [`point ${rows ? rows[vertex] : vertex}`, `moved to ${end.join(", ")}`];
    for (const { name, unit, values } of scalars) {
      const value = values[vertex];
      lines.push(`${name}: ${Number.isNaN(value) ? "no value" : withUnit(value, unit)}`);
    }
    return lines.join("\n");
  }

  // --- scales -------------------------------------------------------------------------------

  const overlay = get("overlay");

  /** Add an element to the drawing over the shapes. */
  function put(name, attributes, text) {
    const element = document.createElementNS(overlay.namespaceURI, name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    if (text !== undefined) element.textContent = text;
    overlay.append(element);
    return element;
  }

  /** The largest of 1, 2, 5 times a power of ten that is at most so long. */
  function round(most) {
    const power = 10 ** Math.floor(Math.log10(most));
    return [5, 2, 1].map((digit) => digit * power).find((length) => length <= most * (1 + 1e-9));
  }

  /** Round numbers from low to high, some four of them. */
  function ticks(low, high) {
    const step = round((high - low) / 2);
    const first = Math.ceil(low / step - 1e-6);
    const last = Math.floor(high / step + 1e-6);
    const decimals = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    return Array.from({ length: last - first + 1 }, (_, i) => {
      const value = (first + i) * step;
      return [value, minus(decimals > 6 ? value.toExponential(1) : value.toFixed(decimals))];
    });
  }

  function drawColours({ name, unit, low, high, over }) {
    const [x, y, wide, thick] = [20, 32, Math.min(220, camera.right), 12];
    put("text", { x, y: 22 }, unit ? `${name} (${unit})` : name);
    data.colormap.forEach((fill, i) => {
      const width = wide / data.colormap.length;
      const rect = { x: x + i * width, y, width: width + 0.5, height: thick, fill };
      put("rect", { ...rect, "shape-rendering": "crispEdges" });
    });
    if (over > 0) {
      const tip = `${x + wide},${y} ${x + wide + 9},${y + thick / 2} ${x + wide},${y + thick}`;
      put("polygon", { points: tip, fill: data.colormap.at(-1) });
    }
    for (const [value, text] of ticks(low, high)) {
      const at = x + (wide * (value - low)) / (high - low);
      put("path", { d: `M${at} ${y + thick}v4`, stroke: "#1c2733" });
      put("text", { x: at, y: y + thick + 16, "text-anchor": "middle" }, text);
    }
    return `Colours: ${name} from ${withUnit(low, unit)} to ${withUnit(high, unit)}.`;
  }

  function drawLength() {
    const perPixel = data.radius / camera.zoom;
    const length = round(Math.min(160, 0.6 * camera.right) * perPixel);
    const [right, y] = [2 * camera.right - 20, 2 * camera.top - 20];
    const left = right - length / perPixel;
    put("path", { d: `M${left} ${y - 5}v5H${right}v-5`, fill: "none", stroke: "#1c2733", "stroke-width": 2 });
    const text = withUnit(length, data.unit);
    put("text", { x: right, y: y - 10, "text-anchor": "end" }, text);
    return `Scale bar: ${text}.`;
  }

  function drawAxes() {
    const [x, y, long] = [52, 2 * camera.top - 52, 30];
    const turned = ["#b3261e", "#1b7a35", "#1f57c3"].map((colour, axis) => {
      const end = new THREE.Vector3().setComponent(axis, 1);
      return { colour, end: end.transformDirection(camera.matrixWorldInverse), text: data.axes[axis] };
    });
    turned.sort((a, b) => a.end.z - b.end.z); // the nearest last
    for (const { colour, end, text } of turned) {
      const flat = Math.hypot(end.x, end.y);
      const tip = [x + long * end.x, y - long * end.y];
      put("path", { d: `M${x} ${y}L${tip.join(" ")}`, stroke: colour, "stroke-width": 2.5 });
      if (flat < 0.3) put("circle", { cx: tip[0], cy: tip[1], r: 3.5, fill: end.z > 0 ? colour : "#fff", stroke: colour });
      // The name of an axis that points at the viewer, or away, stands beside it.
      const [dx, dy] = flat < 0.3 ? [-0.75, 0.75] : [end.x / flat, -end.y / flat];
      const away = flat < 0.3 ? 14 : 10;
      put("text", { x: tip[0] + away * dx, y: tip[1] + away * dy + 4, "text-anchor": "middle", fill: colour, "font-weight": 600 }, text);
    }
  }

  function drawScales() {
    overlay.replaceChildren();
    const said = [];
    if (coloured && moved.visible) said.push(drawColours(coloured));
    drawAxes();
    said.push(drawLength());
    if (picked >= 0 && moved.visible) {
      const { x, y } = onScreen(picked);
      put("circle", { cx: x, cy: y, r: 7, fill: "none", stroke: "#fff", "stroke-width": 4 });
      put("circle", { cx: x, cy: y, r: 7, fill: "none", stroke: "#1c2733", "stroke-width": 2 });
    }
    overlay.setAttribute("aria-label", said.join(" "));
  }

  // --- drawing ------------------------------------------------------------------------------

  function render() {
    for (const shape of Object.values(layers)) {
      shape.material.size = Math.max(2, shape.userData.pointSize * camera.zoom);
    }
    renderer.render(scene, camera);
    drawScales();
  }

  function fit() {
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    renderer.setSize(width, height, false);
    [camera.left, camera.right] = [-width / 2, width / 2];
    [camera.bottom, camera.top] = [-height / 2, height / 2];
    camera.updateProjectionMatrix();
    controls.handleResize();
    controls.panSpeed = width / DISTANCE; // what is under the pointer stays there
    overlay.setAttribute("viewBox", `0 0 ${width} ${height}`);
    if (untouched) reset();
    draw();
  }

  controls.addEventListener("change", draw);
  renderer.setAnimationLoop((now) => {
    if (playing !== null) moveTo((1 - Math.cos((Math.PI * (now - playing)) / 2000)) / 2);
    controls.update();
    if (!stale) return;
    stale = false;
    render();
  });

  // --- pictures -----------------------------------------------------------------------------

  /** The shapes on white with all scales, twice as fine as on the screen, as a PNG file. */
  async function savePicture() {
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    const scales = new Image();
    const drawing = overlay.cloneNode(true);
    drawing.setAttribute("width", 2 * width);
    drawing.setAttribute("height", 2 * height);
    const text = new XMLSerializer().serializeToString(drawing);
    scales.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(text)}`;
    await scales.decode();
    const sheet = document.createElement("canvas");
    [sheet.width, sheet.height] = [2 * width, 2 * height];
    const context = sheet.getContext("2d");
    context.fillStyle = "#fff";
    context.fillRect(0, 0, sheet.width, sheet.height);
    renderer.setPixelRatio(2);
    render(); // what was drawn before is gone from memory by now
    context.drawImage(canvas, 0, 0, sheet.width, sheet.height);
    context.drawImage(scales, 0, 0, sheet.width, sheet.height);
    fit();
    const file = await new Promise((done) => sheet.toBlob(done, "image/png"));
    const link = document.createElement("a");
    link.href = URL.createObjectURL(file);
    link.download = `${document.title.replace(/[^\p{L}\p{N}._-]+/gu, "-")}.png`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60000);
  }

  get("picture").addEventListener("click", () =>
    savePicture().catch((problem) => {
      get("readout").textContent = `The picture could not be saved: ${problem.message}`;
    })
  );

  fit();
  new ResizeObserver(fit).observe(canvas);
  if (scalars.length) colorBy(0);
  moveTo(1);
})();
