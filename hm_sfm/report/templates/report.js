"use strict";

// The table of images, sorted by the column whose heading is clicked.
function makeSortable(table) {
  const body = table.tBodies[0];
  const headings = [...table.tHead.rows[0].cells];
  const order = new Intl.Collator(undefined, { numeric: true });
  headings.forEach((heading, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = heading.textContent;
    heading.replaceChildren(button);
    button.addEventListener("click", () => {
      const falling = heading.getAttribute("aria-sort") === "ascending";
      const compare = (a, b) => column === 0
        ? order.compare(a.cells[0].textContent, b.cells[0].textContent)
        : a.cells[column].dataset.value - b.cells[column].dataset.value;
      const rows = [...body.rows].sort((a, b) => (falling ? compare(b, a) : compare(a, b)));
      body.append(...rows);
      headings.forEach((other) => other.removeAttribute("aria-sort"));
      heading.setAttribute("aria-sort", falling ? "descending" : "ascending");
    });
  });
}

function decode(text, Type) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Type(bytes.buffer);
}

// Points and cameras on a 2D canvas: points are drawn into its pixels against a depth of their own, which needs no GPU.
// The view looks at `target` from `distance`, turned by `yaw` about the vertical and tilted by `pitch`.
function showScene(canvas, data) {
  const points = decode(data.points, Float32Array);
  const colours = decode(data.colours, Uint8Array);
  const frusta = decode(data.frusta, Float32Array);
  const count = points.length / 3;
  const context = canvas.getContext("2d");
  const showCameras = document.getElementById("show-cameras");
  const pointSize = document.getElementById("point-size");
  const cameraName = document.getElementById("camera-name");
  const accent = () => getComputedStyle(canvas).getPropertyValue("--accent");
  // One word a pixel, as ImageData stores it on little-endian machines.
  const words = new Uint32Array(count);
  for (let i = 0; i < count; i++) {
    words[i] = (255 << 24 | colours[3 * i + 2] << 16 | colours[3 * i + 1] << 8 | colours[3 * i]) >>> 0;
  }
  let view, width, height, image, pixels, depths, scheduled = false, chosen = -1;

  function resetView() {
    view = { yaw: 0.35, pitch: 0.3, distance: 1.7, target: [0, 0, 0] };
  }

  function resize() {
    const scale = Math.min(window.devicePixelRatio || 1, 2);
    width = canvas.width = Math.max(1, Math.round(canvas.clientWidth * scale));
    height = canvas.height = Math.max(1, Math.round(canvas.clientHeight * scale));
    image = context.createImageData(width, height);
    pixels = new Uint32Array(image.data.buffer);
    depths = new Float32Array(width * height);
  }

  // Rows of the rotation from the world to the viewer, who looks along -z.
  function axes() {
    const cy = Math.cos(view.yaw), sy = Math.sin(view.yaw), cp = Math.cos(view.pitch), sp = Math.sin(view.pitch);
    return [[cy, 0, -sy], [-sp * sy, cp, -sp * cy], [cp * sy, sp, cp * cy]];
  }

  const focal = () => 1.1 * Math.min(width, height);

  function draw() {
    scheduled = false;
    const [[r0, r1, r2], [u0, u1, u2], [b0, b1, b2]] = axes();
    const [tx, ty, tz] = view.target, { distance } = view, f = focal();
    const largest = 4 * pointSize.value;
    pixels.fill(0);
    depths.fill(Infinity);
    const base = pointSize.value * width / canvas.clientWidth * distance * 0.75;
    for (let i = 0, k = 0; i < count; i++, k += 3) {
      const x = points[k] - tx, y = points[k + 1] - ty, z = points[k + 2] - tz;
      const depth = distance - (b0 * x + b1 * y + b2 * z);
      if (depth < 0.01) continue;
      const size = Math.max(1, Math.min(largest, Math.round(base / depth)));
      const left = Math.floor(width / 2 + f * (r0 * x + r1 * y + r2 * z) / depth - size / 2);
      const top = Math.floor(height / 2 - f * (u0 * x + u1 * y + u2 * z) / depth - size / 2);
      const right = Math.min(left + size, width), bottom = Math.min(top + size, height);
      for (let row = Math.max(top, 0); row < bottom; row++) {
        for (let at = row * width + Math.max(left, 0), end = row * width + right; at < end; at++) {
          if (depth < depths[at]) {
            depths[at] = depth;
            pixels[at] = words[i];
          }
        }
      }
    }
    context.putImageData(image, 0, 0);
    if (showCameras.checked) drawCameras();
  }

  function project(k) {
    const [right, up, back] = axes();
    const p = [0, 1, 2].map((axis) => frusta[k + axis] - view.target[axis]);
    const dot = (axis) => axis[0] * p[0] + axis[1] * p[1] + axis[2] * p[2];
    const depth = view.distance - dot(back);
    if (depth < 0.01) return null;
    return [width / 2 + focal() * dot(right) / depth, height / 2 - focal() * dot(up) / depth];
  }

  function drawCameras() {
    context.strokeStyle = accent();
    for (let camera = 0; camera < data.names.length; camera++) {
      const corners = [0, 1, 2, 3, 4].map((corner) => project(15 * camera + 3 * corner));
      if (corners.includes(null)) continue;
      const [centre, a, b, c, d] = corners;
      context.lineWidth = (camera === chosen ? 3 : 1.2) * width / canvas.clientWidth;
      context.globalAlpha = camera === chosen ? 1 : 0.8;
      context.beginPath();
      [a, b, c, d].forEach((corner) => { context.moveTo(...centre); context.lineTo(...corner); });
      context.moveTo(...a);
      [b, c, d, a].forEach((corner) => context.lineTo(...corner));
      context.stroke();
      // A thicker edge at the top of the stored photo.
      context.lineWidth *= 2.2;
      context.beginPath();
      context.moveTo(...a);
      context.lineTo(...b);
      context.stroke();
    }
    context.globalAlpha = 1;
  }

  function redraw() {
    if (scheduled) return;
    scheduled = true;
    requestAnimationFrame(draw);
  }

  function turn(dx, dy) {
    view.yaw -= dx * 0.006;
    view.pitch = Math.max(-1.57, Math.min(1.57, view.pitch + dy * 0.006));
  }

  function move(dx, dy) {
    const [right, up] = axes();
    const step = view.distance / (focal() * canvas.clientWidth / width);
    view.target = view.target.map((value, axis) => value + step * (up[axis] * dy - right[axis] * dx));
  }

  function zoom(factor) {
    view.distance = Math.max(0.02, Math.min(60, view.distance * factor));
  }

  function nameCamera(event) {
    const frame = canvas.getBoundingClientRect(), scale = width / canvas.clientWidth;
    const x = (event.clientX - frame.left) * scale, y = (event.clientY - frame.top) * scale;
    let nearest = -1, limit = 14 * scale;
    for (let camera = 0; showCameras.checked && camera < data.names.length; camera++) {
      const centre = project(15 * camera);
      const apart = centre ? Math.hypot(centre[0] - x, centre[1] - y) : Infinity;
      if (apart < limit) [nearest, limit] = [camera, apart];
    }
    if (nearest !== chosen) {
      chosen = nearest;
      cameraName.textContent = chosen < 0 ? "" : data.names[chosen];
      redraw();
    }
  }

  // One pointer turns, or moves with Shift or another button; two move and zoom.
  const pointers = new Map();
  function spread() {
    const places = [...pointers.values()];
    const middle = [0, 1].map((axis) => places.reduce((sum, place) => sum + place[axis], 0) / places.length);
    return { middle, apart: Math.hypot(places[0][0] - middle[0], places[0][1] - middle[1]) };
  }
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!pointers.has(event.pointerId)) return nameCamera(event);
    const before = spread();
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    const after = spread();
    const dx = after.middle[0] - before.middle[0], dy = after.middle[1] - before.middle[1];
    if (pointers.size === 1 && !event.shiftKey && !(event.buttons & 6)) {
      turn(dx, dy);
    } else {
      move(dx, dy);
      if (before.apart > 1 && after.apart > 1) zoom(before.apart / after.apart);
    }
    redraw();
  });
  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
  }
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(event.deltaY * (event.deltaMode ? 0.03 : 0.0012)));
    redraw();
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const actions = {
      ArrowLeft: () => turn(-20, 0), ArrowRight: () => turn(20, 0), ArrowUp: () => turn(0, -20),
      ArrowDown: () => turn(0, 20), "+": () => zoom(0.9), "-": () => zoom(1.1), Home: resetView,
    };
    if (!actions[event.key]) return;
    event.preventDefault();
    actions[event.key]();
    redraw();
  });
  showCameras.addEventListener("change", redraw);
  pointSize.addEventListener("input", redraw);
  document.getElementById("reset-view").addEventListener("click", () => { resetView(); redraw(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  new ResizeObserver(() => { resize(); redraw(); }).observe(canvas);

  if (count < 30000) pointSize.value = 3;
  resetView();
  resize();
  draw();
  // For those who want to know whether anything is to be seen.
  canvas.dataset.pointPixels = pixels.reduce((sum, pixel) => sum + (pixel !== 0), 0);
}

makeSortable(document.getElementById("images"));
const sceneData = document.getElementById("scene-data");
if (sceneData) showScene(document.getElementById("scene"), JSON.parse(sceneData.textContent));
