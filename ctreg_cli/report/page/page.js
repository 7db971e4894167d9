"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const byId = (id) => document.getElementById(id);
  const slices = data.slices;
  const slider = byId("slider"), view = byId("view"), canvas = byId("scene");
  const SVG = "http://www.w3.org/2000/svg";
  const RESIDUAL_ZOOM = 50;
  const LABEL_AT = 0.85;
  let at = 0;

  // ---- one slice -------------------------------------------------------------------------------------------------
  function element(name, attributes, text) {
    const made = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (text !== undefined) made.textContent = text;
    return made;
  }

  function unseenIn(slice) {
    // where the pose puts rods that no spot was matched to; a rod that ends short of the slice crosses it nowhere
    if (!slice.T || !slice.scale) return [];
    return data.rods.filter((rod) => slice.missing.includes(rod.id)).flatMap((rod) => {
      const [p, q] = rod.ends.map((end) => moved(slice.T, end)), t = p[2] / (p[2] - q[2]);
      if (!(t >= 0 && t <= 1)) return [];
      return [{ id: rod.id, place: [0, 1].map((k) => (p[k] + t * (q[k] - p[k])) / slice.scale[k]) }];
    });
  }

  function drawView(slice) {
    view.replaceChildren();
    view.setAttribute("class", slice.status + (slice.picture ? " pictured" : ""));
    if (!data.view) return;
    const [u0, v0, side] = data.view;
    view.setAttribute("viewBox", `${u0} ${v0} ${side} ${side}`);
    if (slice.picture)
      view.append(element("image", { href: slice.picture, x: u0, y: v0, width: side, height: side }));
    const size = side / 26, middle = [u0 + side / 2, v0 + side / 2];
    const within = ([u, v]) => u >= u0 && u <= u0 + side && v >= v0 && v <= v0 + side;
    const free = slice.free.filter(within), unseen = unseenIn(slice).filter(({ place }) => within(place));
    for (const [u, v] of free) view.append(element("circle", { class: "free", cx: u, cy: v, r: size * 0.45 }));
    for (const { id, place: [u, v] } of unseen) {
      const r = size * 0.3;
      view.append(element("path", { class: "unseen", d: `M${u - r} ${v - r}L${u + r} ${v + r}M${u - r} ${v + r}L${u + r} ${v - r}` }));
      view.append(element("text", { class: "unseen", x: u, y: v - size, "font-size": size, "text-anchor": "middle", "dominant-baseline": "middle" }, id));
    }
    for (const [rod, u, v, ru, rv] of slice.spots) {
      const away = Math.hypot(u - middle[0], v - middle[1]), outwards = away > size ? [(u - middle[0]) / away, (v - middle[1]) / away] : [0, -1];
      const x = u + 1.6 * size * outwards[0], y = v + 1.6 * size * outwards[1];
      view.append(element("circle", { cx: u, cy: v, r: size * 0.45 }));
      view.append(element("line", { class: "arrow", x1: u, y1: v, x2: u + RESIDUAL_ZOOM * ru, y2: v + RESIDUAL_ZOOM * rv }));
      view.append(element("text", { x, y, "font-size": size, "text-anchor": "middle", "dominant-baseline": "middle" }, rod));
    }
    const outside = slice.free.length - free.length;
    byId("matched-key").hidden = !slice.spots.length;
    byId("free-key").hidden = !slice.free.length;
    byId("unseen-key").hidden = !unseen.length;
    byId("free-count").textContent = `${slice.free.length}${outside ? `, ${free.length ? outside : "all"} outside this view` : ""}`;
    byId("magnified").textContent = `lines are residuals, ${RESIDUAL_ZOOM} times as long`;
  }

  function show(index) {
    if (!slices.length) return;
    at = Math.max(0, Math.min(slices.length - 1, index));
    const slice = slices[at];
    slider.value = at;
    slider.setAttribute("aria-valuetext", `slice ${slice.i}, ${slice.status}`);
    byId("verdict").textContent = `Slice ${slice.i}, ${slice.source}: ${slice.text}`;
    byId("here").setAttribute("x", at);
    for (const now of document.querySelectorAll(".now")) {
      const [low, high, start, stop] = ["low", "high", "start", "stop"].map((name) => Number(now.dataset[name]));
      const x = start + (data.x[at] - low) / (high - low) * (stop - start);
      now.setAttribute("x1", x);
      now.setAttribute("x2", x);
    }
    drawView(slice);
    drawScene();
  }

  // ---- 3D scene, in slice coordinates ------------------------------------------------------------------------------
  const START = { turn: -35, tilt: 62, zoom: 1 };
  const FILLED = 0.92, FARTHEST = 4;
  const camera = { ...START };
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  const moved = (T, p) => [0, 1, 2].map((r) => T[4 * r] * p[0] + T[4 * r + 1] * p[1] + T[4 * r + 2] * p[2] + T[4 * r + 3]);

  function sceneOf(slice) {
    const [s_x, s_y] = slice.scale || [1, 1];
    const spots = slice.spots.map(([rod, u, v]) => ({ rod, place: [u * s_x, v * s_y, 0] }));
    const matched = new Set(slice.spots.map((spot) => spot[0]));
    const rods = slice.T ? data.rods.map((rod) => ({
      id: rod.id, ends: rod.ends.map((end) => moved(slice.T, end)), matched: matched.has(rod.id), missing: slice.missing.includes(rod.id),
    })) : [];
    const free = slice.free.map(([u, v]) => [u * s_x, v * s_y, 0]);
    const targets = slice.T ? slice.tre.map(([id, place, tre]) => ({ id, place, tre })) : [];
    let plane = [];
    if (data.view) {
      const [u0, v0, side] = data.view;
      plane = [[0, 0], [1, 0], [1, 1], [0, 1]].map(([a, b]) => [(u0 + a * side) * s_x, (v0 + b * side) * s_y, 0]);
    }
    return { spots, free, rods, targets, plane };
  }

  function turned(p, { turn, tilt }) {
    // right, down and towards the eye
    const [sinTurn, cosTurn, sinTilt, cosTilt] = [turn, tilt].flatMap((angle) => [Math.sin(angle * Math.PI / 180), Math.cos(angle * Math.PI / 180)]);
    const right = cosTurn * p[0] - sinTurn * p[1], back = sinTurn * p[0] + cosTurn * p[1];
    return [right, back * cosTilt - p[2] * sinTilt, back * sinTilt + p[2] * cosTilt];
  }

  function extent() {
    // the same for all slices, so that nothing jumps while sliding; all is in view as the scene is first seen
    const scenes = slices.map(sceneOf);
    const frame = scenes.flatMap((scene) => [...scene.plane, ...scene.rods.flatMap((rod) => rod.ends)]);
    if (!frame.length) return { middle: [0, 0, 0], radius: 1 };
    const span = (places, k) => places.reduce(([low, high], p) => [Math.min(low, p[k]), Math.max(high, p[k])], [Infinity, -Infinity]);
    const centre = (places) => [0, 1, 2].map((k) => { const [low, high] = span(places, k); return (low + high) / 2; });
    const from = centre(frame), apart = (p) => Math.hypot(...p.map((value, k) => value - from[k]));
    // a target far away would leave of the frame only a dot
    const limit = FARTHEST * frame.reduce((most, p) => Math.max(most, apart(p)), 0);
    const points = [...frame, ...scenes.flatMap((scene) => scene.targets.map((target) => target.place)).filter((p) => apart(p) <= limit)];
    const middle = centre(points);
    const seen = points.map((p) => turned(p.map((value, k) => value - middle[k]), START));
    const reach = [0, 1].flatMap((k) => span(seen, k).map(Math.abs));
    return { middle, radius: Math.max(...reach) || 1 };
  }
  const { middle, radius } = extent();

  function drawScene() {
    const box = canvas.getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
    const width = Math.max(1, Math.round(box.width * ratio)), height = Math.max(1, Math.round(box.height * ratio));
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    const g = canvas.getContext("2d");
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, box.width, box.height);
    if (!slices.length) return;
    const scale = FILLED * Math.min(box.width, box.height) / 2 / radius * camera.zoom;
    const project = (p) => {
      const [right, down, depth] = turned(p.map((value, k) => value - middle[k]), camera);
      return { x: box.width / 2 + scale * right, y: box.height / 2 + scale * down, depth };
    };
    const scene = sceneOf(slices[at]);
    const ink = colour("ink"), soft = colour("soft");
    const mark = colour(slices[at].status);
    g.lineCap = "round";
    g.font = "12px system-ui, sans-serif";
    const line = (p, q, stroke, thick, dash) => {
      const a = project(p), b = project(q);
      g.strokeStyle = stroke; g.lineWidth = thick; g.setLineDash(dash || []);
      g.beginPath(); g.moveTo(a.x, a.y); g.lineTo(b.x, b.y); g.stroke(); g.setLineDash([]);
    };
    // words with a halo, so that rods behind them do not cross them out; those near the right edge stand left of it
    const write = (text, x, y, fill) => {
      const place = Math.max(2, Math.min(x, box.width - g.measureText(text).width - 4));
      g.strokeStyle = colour("panel"); g.lineWidth = 4; g.lineJoin = "round"; g.strokeText(text, place, y);
      g.fillStyle = fill; g.fillText(text, place, y);
    };
    const dot = (p, size, fill) => { const a = project(p); g.fillStyle = fill; g.beginPath(); g.arc(a.x, a.y, size, 0, 7); g.fill(); return a; };
    const drawPlane = () => {
      if (!scene.plane.length) return;
      g.beginPath();
      scene.plane.forEach((p, k) => { const a = project(p); k ? g.lineTo(a.x, a.y) : g.moveTo(a.x, a.y); });
      g.closePath();
      g.fillStyle = colour("plane"); g.fill();
      g.strokeStyle = soft; g.lineWidth = 1; g.stroke();
    };
    // rods are cut at the plane: the half behind it is drawn first, then the plane, then the half before it
    const facing = project([middle[0], middle[1], middle[2] + 1]).depth > project(middle).depth ? 1 : -1;
    const halves = scene.rods.flatMap((rod) => {
      const [p, q] = rod.ends;
      if (p[2] * q[2] >= 0) return [{ rod, p, q, side: Math.sign(p[2] + q[2]) }];
      const t = p[2] / (p[2] - q[2]), cut = p.map((value, k) => value + t * (q[k] - value));
      return [{ rod, p, q: cut, side: Math.sign(p[2]) }, { rod, p: cut, q, side: Math.sign(q[2]) }];
    });
    const drawHalf = ({ rod, p, q }) => line(p, q, rod.missing ? colour("missing") : rod.matched ? colour("line") : soft, 3, rod.matched ? [] : [4, 5]);
    halves.filter((half) => half.side * facing < 0).forEach(drawHalf);
    drawPlane();
    halves.filter((half) => half.side * facing >= 0).forEach(drawHalf);
    for (const { id, ends: [p, q] } of scene.rods) {
      const a = project(p.map((value, k) => value + LABEL_AT * (q[k] - value)));  // ends of rods often meet, these do not
      write(id, a.x + 6, a.y + 4, soft);
    }
    for (const place of scene.free) {
      const a = project(place);
      if (a.x < 0 || a.y < 0 || a.x > box.width || a.y > box.height) continue;
      g.strokeStyle = colour("free"); g.lineWidth = 2; g.beginPath(); g.arc(a.x, a.y, 4, 0, 7); g.stroke();
    }
    for (const spot of scene.spots) dot(spot.place, 4.5, mark);
    for (const target of scene.targets) {
      const a = project(target.place);
      g.strokeStyle = ink; g.lineWidth = 2; g.beginPath();
      g.moveTo(a.x - 6, a.y); g.lineTo(a.x + 6, a.y); g.moveTo(a.x, a.y - 6); g.lineTo(a.x, a.y + 6); g.stroke();
      write(`${target.id} ± ${target.tre.toPrecision(2)} mm`, a.x + 9, a.y + 14, ink);
    }
    drawAxes(project, line, write);
    if (!slices[at].T) { g.fillStyle = mark; g.fillText("no pose in this slice", 12, 22); }
    else if (!data.rods.length) { g.fillStyle = soft; g.fillText("the frame was not given: no rods", 12, 22); }
  }

  function drawAxes(project, line, write) {
    const length = 0.18 * radius, origin = data.view && slices[at].scale
      ? [data.view[0] * slices[at].scale[0], data.view[1] * slices[at].scale[1], 0] : middle;
    [["x", 0], ["y", 1], ["z", 2]].forEach(([name, k]) => {
      const tip = origin.map((value, j) => value + (j === k ? length : 0));
      line(origin, tip, colour("soft"), 1.5);
      const a = project(tip);
      write(name, a.x + 3, a.y + 3, colour("soft"));
    });
  }

  function turnBy(turn, tilt) {
    camera.turn += turn;
    camera.tilt = Math.max(0, Math.min(180, camera.tilt + tilt));
    drawScene();
  }
  function zoomBy(factor) { camera.zoom = Math.max(0.3, Math.min(12, camera.zoom * factor)); drawScene(); }
  function onPaper(is) { document.documentElement.classList.toggle("paper", is); drawScene(); }
  function reset() { Object.assign(camera, START); drawScene(); }

  // ---- hands ---------------------------------------------------------------------------------------------------------
  slider.max = Math.max(0, slices.length - 1);
  slider.addEventListener("input", () => show(Number(slider.value)));
  byId("back").addEventListener("click", () => show(at - 1));
  byId("on").addEventListener("click", () => show(at + 1));
  byId("strip").addEventListener("click", (event) => {
    const box = byId("strip").getBoundingClientRect();
    show(Math.floor((event.clientX - box.left) / box.width * slices.length));
  });
  document.addEventListener("click", (event) => {
    const link = event.target.closest("[data-at]");
    if (link) show(Number(link.dataset.at));
  });
  for (const button of document.querySelectorAll("[data-turn]"))
    button.addEventListener("click", () => turnBy(...button.dataset.turn.split(" ").map(Number)));
  for (const button of document.querySelectorAll("[data-zoom]"))
    button.addEventListener("click", () => zoomBy(Number(button.dataset.zoom)));
  byId("reset").addEventListener("click", reset);
  canvas.addEventListener("keydown", (event) => {
    const steps = { ArrowLeft: [-10, 0], ArrowRight: [10, 0], ArrowUp: [0, -10], ArrowDown: [0, 10] };
    if (steps[event.key]) turnBy(...steps[event.key]);
    else if (event.key === "+" || event.key === "=") zoomBy(1.2);
    else if (event.key === "-") zoomBy(1 / 1.2);
    else if (event.key === "0") reset();
    else return;
    event.preventDefault();
  });
  const fingers = new Map();
  let spread = 0;
  canvas.addEventListener("pointerdown", (event) => { fingers.set(event.pointerId, event); canvas.setPointerCapture(event.pointerId); spread = 0; });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => { fingers.delete(event.pointerId); spread = 0; });
  canvas.addEventListener("pointermove", (event) => {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    fingers.set(event.pointerId, event);
    if (fingers.size === 1) { turnBy(0.4 * (event.clientX - last.clientX), 0.4 * (event.clientY - last.clientY)); return; }
    const [a, b] = [...fingers.values()], now = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
    if (spread) zoomBy(now / spread);
    spread = now;
  });
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas) return;  // scrolling past the scene shall not be caught by it
    event.preventDefault();
    zoomBy(Math.exp(-event.deltaY / 500));
  }, { passive: false });
  window.addEventListener("resize", drawScene);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawScene);
  window.addEventListener("beforeprint", () => {
    for (const part of document.querySelectorAll("details")) part.open = true;
    onPaper(true);
  });
  window.addEventListener("afterprint", () => onPaper(false));
  show(Math.max(0, slices.findIndex((slice) => slice.status === "ok")));
})();
