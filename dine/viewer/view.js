// The viewer of view.html: source, target and moved source with three.js, from the JSON in #data.
"use strict";
(() => {
  const get = (id) => document.getElementById(id);
  const data = JSON.parse(get("data").textContent);
  const canvas = get("stage");
  const NO_VALUE = [0.72, 0.75, 0.78];

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

  // --- scene --------------------------------------------------------------------------------

  const scene = new THREE.Scene();
  const camera = new THREE.PerspectiveCamera(30, 1, 0.01, 100);

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
  function shapeOf(geometry, color, pointSize) {
    if (!geometry.index) {
      // three.js takes sizes as if the field of view were 90 degrees.
      const size = pointSize / Math.tan((camera.fov / 2) * (Math.PI / 180));
      const material = new THREE.PointsMaterial({ color, size, map: ball, alphaToCoverage: true });
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
          float facing = abs(dot(normalize(vViewPosition), normal));
          float rim = pow(1.0 - facing, 1.5);
          diffuseColor.a = mix(opacity * opacity, min(1.0, 1.8 * opacity), rim);
        #endif
        #include <opaque_fragment>`
      );
    };
    return new THREE.Mesh(geometry, material);
  }

  function setOpacity(shape, opacity) {
    const { material } = shape;
    const seeThrough = opacity < 1;
    material.opacity = opacity;
    material.transparent = seeThrough;
    material.depthWrite = !seeThrough;
    material.polygonOffset = seeThrough; // where surfaces coincide, the opaque one is in front
    material.polygonOffsetFactor = material.polygonOffsetUnits = 2;
    material.alphaTest = material.map ? 0.5 * opacity : 0;
    material.defines = seeThrough ? { SEE_THROUGH: "" } : {};
    material.needsUpdate = true;
    shape.renderOrder = seeThrough ? 1 : 0;
  }

  scene.add(camera, new THREE.HemisphereLight(0xffffff, 0xd5dbe2, 2.1));
  const light = new THREE.DirectionalLight(0xffffff, 1.7);
  light.position.set(-0.5, 0.8, 1);
  camera.add(light);
  camera.add(light.target);
  light.target.position.set(0, 0, -1);

  const moving = geometryOf(source, sourceFaces);
  const end = geometryOf(result, sourceFaces);
  moving.morphAttributes.position = [end.attributes.position];
  if (sourceFaces) moving.morphAttributes.normal = [end.attributes.normal];

  const geometries = {
    moved: moving,
    target: geometryOf(decode(data.target.positions), targetFaces),
    source: geometryOf(source, sourceFaces),
  };
  const layers = {};
  for (const { id, color, opacity, shown } of data.layers) {
    const size = (id === "target" ? data.target : data.source).pointSize;
    const shape = shapeOf(geometries[id], color, size);
    setOpacity(shape, opacity / 100);
    shape.visible = shown;
    layers[id] = shape;
    scene.add(shape);
    get(`show-${id}`).addEventListener("change", (event) => {
      shape.visible = event.target.checked;
      draw();
    });
    get(`opacity-${id}`).addEventListener("input", (event) => {
      setOpacity(shape, event.target.value / 100);
      draw();
    });
  }
  const moved = layers.moved;
  const plain = moved.material.color.clone();
  moved.updateMorphTargets();

  // --- colours ------------------------------------------------------------------------------

  const minus = (text) => text.replaceAll("-", "−");
  const digits = (value) => minus(String(Number(value.toPrecision(4))));

  /** Writes numbers of a range with equally many decimals, three digits for its width. */
  function scaleFormat(range) {
    const decimals = Math.max(0, 2 - Math.floor(Math.log10(range || 1)));
    return (value) => minus(decimals > 6 ? value.toExponential(2) : value.toFixed(decimals));
  }

  const RAMP = `linear-gradient(to right, ${data.colormap.join(",")})`;

  function colorBy(index) {
    const chosen = scalars[index] || null;
    const { material } = moved;
    material.vertexColors = chosen !== null;
    material.color.copy(plain);
    if (chosen) {
      material.color.set(0xffffff);
      moving.setAttribute("color", new THREE.BufferAttribute(colorsOf(chosen), 3));
    }
    material.needsUpdate = true;
    get("bar").hidden = !chosen;
    get("swatch-moved").style.background = chosen ? RAMP : data.layers[0].color;
    if (chosen) labelBar(chosen);
    draw();
  }

  function labelBar({ low, high, over, missing, unit }) {
    const format = scaleFormat(high - low);
    get("ticks").replaceChildren(
      ...[0, 0.25, 0.5, 0.75, 1].map((share) => {
        const tick = document.createElement("span");
        const sign = share === 1 && over > 0 ? "≥ " : "";
        tick.textContent = sign + format(low + share * (high - low));
        tick.style.left = `${100 * share}%`;
        return tick;
      })
    );
    const notes = [unit ? `in ${unit}` : "without unit"];
    if (over > 0) notes.push(`${over} points above the scale`);
    if (missing > 0) notes.push(`grey: ${missing} points without a value`);
    get("note").textContent = notes.join("; ");
  }

  if (scalars.length) {
    get("ramp").style.background = RAMP;
    get("scalar").addEventListener("change", (event) => colorBy(Number(event.target.value)));
  }

  // --- motion -------------------------------------------------------------------------------

  const morph = get("morph");
  let playing = null;

  function moveTo(share) {
    moved.morphTargetInfluences[0] = share;
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
  controls.panSpeed = 0.6;
  controls.dynamicDampingFactor = 0.18;
  controls.keys = [];
  controls.minDistance = 0.05; // all shapes together have radius 1 and their middle at 0
  controls.maxDistance = 40;

  /** Look at the middle from a direction, with everything in the picture. */
  function lookFrom(direction, up) {
    const half = (camera.fov / 2) * (Math.PI / 180);
    const narrow = Math.min(1, camera.aspect);
    const distance = 1.04 / Math.sin(Math.atan(Math.tan(half) * narrow));
    controls.reset();
    controls.target.set(0, 0, 0);
    camera.position.set(...direction).normalize().multiplyScalar(distance);
    camera.up.set(...up);
    camera.near = distance / 500;
    camera.far = distance * 60;
    camera.updateProjectionMatrix();
    controls.update();
    draw();
  }

  const SIDES = [
    [[1, 0, 0], [0, 0, 1]], [[-1, 0, 0], [0, 0, 1]], [[0, 1, 0], [0, 0, 1]],
    [[0, -1, 0], [0, 0, 1]], [[0, 0, 1], [0, 1, 0]], [[0, 0, -1], [0, 1, 0]],
  ];
  const reset = () => lookFrom(data.view.direction, data.view.up);
  for (const button of document.querySelectorAll("[data-side]")) {
    button.addEventListener("click", () => lookFrom(...SIDES[button.dataset.side]));
  }
  get("reset").addEventListener("click", reset);

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
    step.multiplyScalar(eye.length());
    camera.position.add(step);
    controls.target.add(step);
  }

  function zoom(factor) {
    const eye = camera.position.clone().sub(controls.target).multiplyScalar(factor);
    eye.clampLength(controls.minDistance, controls.maxDistance);
    camera.position.copy(controls.target).add(eye);
  }

  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const arrow = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[
      event.key
    ];
    if (arrow && event.shiftKey) shift(-0.03 * arrow[0], -0.03 * arrow[1]);
    else if (arrow) turn(-0.12 * arrow[0], -0.12 * arrow[1]);
    else if (event.key === "+" || event.key === "=") zoom(0.9);
    else if (event.key === "-" || event.key === "_") zoom(1 / 0.9);
    else if (event.key === "0") reset();
    else return;
    event.preventDefault();
    draw();
  });

  // --- values at a click --------------------------------------------------------------------

  /** Index of the frontmost vertex of the moved source within 12 pixels of a place, or -1. */
  function pick(x, y) {
    if (!moved.visible) return -1;
    camera.updateMatrixWorld();
    const share = moved.morphTargetInfluences[0];
    const point = new THREE.Vector3();
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    let [best, depth] = [-1, Infinity];
    for (let i = 0; i < source.length; i += 3) {
      point.set(
        source[i] + share * (result[i] - source[i]),
        source[i + 1] + share * (result[i + 1] - source[i + 1]),
        source[i + 2] + share * (result[i + 2] - source[i + 2])
      );
      point.project(camera);
      const off = Math.hypot((0.5 + point.x / 2) * width - x, (0.5 - point.y / 2) * height - y);
      // Behind by a little is better than beside: the nearest pixel counts as depth, too.
      if (off < 12 && Math.abs(point.z) <= 1 && point.z + 1e-5 * off < depth) {
        [best, depth] = [i / 3, point.z + 1e-5 * off];
      }
    }
    return best;
  }

  let pressed = null;
  canvas.addEventListener("pointerdown", (event) => {
    pressed = [event.clientX, event.clientY];
  });
  canvas.addEventListener("pointerup", (event) => {
    if (!pressed || Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > 3) return;
    const box = canvas.getBoundingClientRect();
    const vertex = pick(event.clientX - box.left, event.clientY - box.top);
    get("readout").textContent = vertex < 0 ? "" : describe(vertex);
  });

  function describe(vertex) {
    const place = data.centre.map((middle, axis) => {
      return middle + data.radius * result[3 * vertex + axis];
    });
    const lines = [`point ${rows ? rows[vertex] : vertex}`, `moved to ${place.map(digits).join(", ")}`];
    for (const { name, unit, values } of scalars) {
      const value = values[vertex];
      lines.push(`${name}: ${Number.isNaN(value) ? "no value" : `${digits(value)} ${unit}`}`);
    }
    return lines.join("\n");
  }

  // --- drawing ------------------------------------------------------------------------------

  let stale = true;
  function draw() {
    stale = true;
  }

  function fit() {
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    renderer.setSize(width, height, false);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    controls.handleResize();
    draw();
  }

  controls.addEventListener("change", draw);
  renderer.setAnimationLoop((now) => {
    if (playing !== null) moveTo((1 - Math.cos((Math.PI * (now - playing)) / 2000)) / 2);
    controls.update();
    if (!stale) return;
    stale = false;
    renderer.render(scene, camera);
  });

  fit();
  new ResizeObserver(fit).observe(canvas);
  reset();
  if (scalars.length) colorBy(0);
  moveTo(1);
})();
