"use strict";
if (byId("replay-app")) report.ready.then(content => {
  if (!content.scenes.length) return;
  byId("replay-app").hidden = false;
  const SIDES = ["baseline", "policy"], LANE_M = 3.2, WIDTH_M = 1.9, FAST_MPS = 15;
  const SPEEDS = [[165, 0, 38], [215, 48, 39], [244, 109, 67], [240, 170, 40], [120, 190, 170], [69, 137, 199], [49, 84, 165]];
  const CV = "#1f9be0", HDV = "#f2a33a", SIGNAL = { g: "#19c25f", y: "#ffcf26", r: "#ff3b30" };
  const loaded = new Map();
  const state = { scene: null, frame: 0, playing: false, last: 0, span: 150, shift: [0, 0] };

  const speedColour = speed => {
    const at = Math.max(0, Math.min(1, speed / FAST_MPS)) * (SPEEDS.length - 1), k = Math.min(SPEEDS.length - 2, Math.floor(at));
    const mix = SPEEDS[k].map((value, c) => Math.round(value + (at - k) * (SPEEDS[k + 1][c] - value)));
    return `rgb(${mix.join(",")})`;
  };
  const palette = Array.from({ length: 31 }, (_, k) => speedColour(k / 2));
  const paintOf = (vehicle, speed) => byId("paint").value === "kind" ? (vehicle.cv ? CV : HDV) : palette[Math.max(0, Math.min(30, Math.round(2 * speed)))];

  // -- data -----------------------------------------------------------------------------------------------------------

  const decodeVehicle = ([first, cv, length, approach, exit, runs, packed]) => {
    const path = new Float32Array(packed.length), run = new Uint16Array(packed.length);
    for (let i = 0, x = 0, v = 0; i < packed.length; i++) { v += packed[i]; x += v; path[i] = x / 10; }
    let at = 0;
    runs.forEach(([, frames], k) => { run.fill(k, at, at + frames); at += frames; });
    return { first, last: first + path.length - 1, cv: Boolean(cv), length: length / 10, approach, exit, path, run, runs: runs.map(([lane, , begin]) => ({ lane, begin: begin / 10 })) };
  };

  const decode = text => {
    const raw = JSON.parse(text);
    raw.net.lanes.forEach(lane => {
      lane.run = [0];
      for (let i = 2; i < lane.p.length; i += 2) lane.run.push(lane.run.at(-1) + Math.hypot(lane.p[i] - lane.p[i - 2], lane.p[i + 1] - lane.p[i - 1]));
    });
    SIDES.forEach(side => { raw[side].vehicles = raw[side].vehicles.map(decodeVehicle); });
    raw.frames = Math.max(...SIDES.map(side => raw[side].frames));
    return raw;
  };

  const speedAt = (vehicle, i, step) => {
    const k = Math.max(1, Math.min(vehicle.path.length - 1, i));
    return vehicle.path.length < 2 ? 0 : Math.max(0, (vehicle.path[k] - vehicle.path[k - 1]) / step);
  };

  const poseOn = (lane, position) => {
    const along = Math.max(0, Math.min(1, position / Math.max(lane.n, 1e-6))) * lane.run.at(-1);
    let k = 1;
    while (k < lane.run.length - 1 && lane.run[k] < along) k++;
    const [x0, y0, x1, y1] = lane.p.slice(2 * k - 2, 2 * k + 2);
    const part = (along - lane.run[k - 1]) / Math.max(lane.run[k] - lane.run[k - 1], 1e-6);
    return [x0 + part * (x1 - x0), y0 + part * (y1 - y0), Math.atan2(y1 - y0, x1 - x0)];
  };

  /** Position of the front bumper and heading at a frame that may lie between two recorded ones. */
  const poseAt = (net, vehicle, frame) => {
    const i = Math.min(vehicle.path.length - 1, Math.max(0, Math.floor(frame - vehicle.first))), rest = Math.min(1, frame - vehicle.first - i);
    const here = vehicle.runs[vehicle.run[i]], from = poseOn(net.lanes[here.lane], vehicle.path[i] - here.begin);
    if (i + 1 >= vehicle.path.length || rest <= 0) return from;
    const there = vehicle.runs[vehicle.run[i + 1]], to = poseOn(net.lanes[there.lane], vehicle.path[i + 1] - there.begin);
    const turn = Math.atan2(Math.sin(to[2] - from[2]), Math.cos(to[2] - from[2]));
    return [from[0] + rest * (to[0] - from[0]), from[1] + rest * (to[1] - from[1]), from[2] + rest * turn];
  };

  const signalsAt = (episode, frame) => {
    let colours = episode.signals[0][1];
    for (const [begin, text] of episode.signals) { if (begin > frame) break; colours = text; }
    return colours;
  };

  // -- drawing --------------------------------------------------------------------------------------------------------

  const prepare = canvas => {
    const ratio = Math.min(2, devicePixelRatio || 1), { width, height } = canvas.getBoundingClientRect();
    const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    return [pen, width, height];
  };

  const follow = (pen, points) => {
    pen.beginPath();
    for (let i = 0; i < points.length; i += 2) i ? pen.lineTo(points[i], points[i + 1]) : pen.moveTo(points[i], points[i + 1]);
    pen.stroke();
  };

  const drawNet = (pen, net) => {
    pen.lineCap = "butt"; pen.lineJoin = "round";
    for (const where of [1, 0, 2]) {
      pen.lineWidth = where === 1 ? 2 * LANE_M : LANE_M;
      pen.strokeStyle = colourOf(where === 1 ? "--inside" : "--asphalt");
      net.lanes.filter(lane => lane.w === where).forEach(lane => follow(pen, lane.p));
    }
    pen.strokeStyle = colourOf("--mark"); pen.lineWidth = 0.18; pen.setLineDash([2, 3]);
    net.lanes.filter(lane => lane.s).forEach(lane => {
      const line = [];
      for (let i = 0; i < lane.p.length; i += 2) {
        const a = Math.max(0, i - 2), b = Math.min(lane.p.length - 2, i + 2);
        const dx = lane.p[b] - lane.p[a], dy = lane.p[b + 1] - lane.p[a + 1], d = Math.hypot(dx, dy) || 1;
        line.push(lane.p[i] - dy / d * LANE_M / 2, lane.p[i + 1] + dx / d * LANE_M / 2);
      }
      follow(pen, line);
    });
    pen.setLineDash([]);
  };

  const drawSignals = (pen, net, colours) => {
    pen.lineWidth = 1.1;
    net.stops.forEach(([number, approach, exits]) => {
      const lane = net.lanes[number], [x, y, heading] = poseOn(lane, lane.n);
      const seen = exits.map(exit => colours[approach * net.exits.length + exit]);
      const [c, s] = [Math.cos(heading), Math.sin(heading)];
      pen.strokeStyle = SIGNAL[["g", "y", "r"].find(colour => seen.includes(colour)) ?? "r"];
      follow(pen, [x - s * 1.45, y + c * 1.45, x + s * 1.45, y - c * 1.45]);
    });
  };

  const drawVehicle = (pen, vehicle, [x, y, heading], fill) => {
    pen.save();
    pen.translate(x, y); pen.rotate(heading);
    pen.beginPath();
    pen.roundRect(-vehicle.length, -WIDTH_M / 2, vehicle.length, WIDTH_M, 0.5);
    pen.fillStyle = fill; pen.fill();
    pen.lineWidth = vehicle.cv ? 0.45 : 0.15;
    pen.strokeStyle = vehicle.cv ? "#ffffff" : "#10151a";
    pen.stroke();
    if (vehicle.cv) { pen.beginPath(); pen.arc(-vehicle.length / 2, 0, 0.5, 0, 7); pen.fillStyle = "#ffffff"; pen.fill(); }
    pen.restore();
  };

  const drawMap = side => {
    const data = state.scene, episode = data[side], [pen, width, height] = prepare(byId(`${side}-map`));
    const scale = Math.min(width, height * 1.2) / state.span, frame = Math.min(state.frame, data.frames - 1);
    pen.translate(width / 2, height / 2); pen.scale(scale, -scale); pen.translate(-state.shift[0], -state.shift[1]);
    drawNet(pen, data.net);
    drawSignals(pen, data.net, signalsAt(episode, frame));
    let stopped = 0, present = 0;
    for (const vehicle of episode.vehicles) {
      if (vehicle.first > frame || vehicle.last < frame) continue;
      const speed = speedAt(vehicle, Math.floor(frame - vehicle.first), data.frame_s);
      present += 1; stopped += speed < 1 ? 1 : 0;
      drawVehicle(pen, vehicle, poseAt(data.net, vehicle, frame), paintOf(vehicle, speed));
    }
    const counter = episode.counters[Math.min(episode.counters.length - 1, Math.floor(frame / episode.counter_steps))];
    const grams = counter[0] ? `${(counter[1] / counter[0]).toFixed(1)} g CO2 each` : "";
    byId(`${side}-count`).textContent = `${counter[0]} crossed, ${grams}${grams ? ", " : ""}${stopped} of ${present} stopped`;
  };

  /** The exit that most vehicles of the approach go to: its signal is drawn at the stop line. */
  const mainExit = (episode, approach) => {
    const tally = new Map();
    episode.vehicles.filter(v => v.approach === approach).forEach(v => tally.set(v.exit, (tally.get(v.exit) ?? 0) + 1));
    return [...tally].sort((a, b) => b[1] - a[1])[0]?.[0] ?? 0;
  };

  const pictures = new Map();
  const timeSpace = (side, width, height, ratio) => {
    const data = state.scene, episode = data[side], picture = new OffscreenCanvas(width * ratio, height * ratio);
    const pen = picture.getContext("2d"), approach = data.approach, mine = episode.vehicles.filter(v => v.approach === approach);
    const both = SIDES.flatMap(name => data[name].vehicles.filter(v => v.approach === approach));
    const far = Math.min(-60, ...both.map(v => v.path[0])), near = 60;
    const box = { left: 46, right: width - 8, top: 10, bottom: height - 30 };
    const x = frame => box.left + frame / data.frames * (box.right - box.left), y = m => box.bottom - (m - far) / (near - far) * (box.bottom - box.top);
    pen.scale(ratio, ratio);
    pen.font = "11px system-ui, sans-serif"; pen.fillStyle = colourOf("--quiet"); pen.strokeStyle = colourOf("--grid"); pen.lineWidth = 1;
    const seconds = data.frames * data.frame_s, tick = [20, 30, 60, 120, 200, 300].find(s => seconds / s <= width / 90) ?? 600;
    pen.textAlign = "center";
    for (let t = 0; t <= seconds; t += tick) { follow(pen, [x(t / data.frame_s), box.top, x(t / data.frame_s), box.bottom]); pen.fillText(t === 0 ? "0 s" : String(t), Math.min(x(t / data.frame_s), width - 16), height - 12); }
    pen.textAlign = "right";
    const gap = [25, 50, 100, 200].find(m => (near - far) / m <= 6) ?? 400;
    for (let m = 0; m >= far; m -= gap) { follow(pen, [box.left, y(m), box.right, y(m)]); pen.fillText(`${m || 0} m`, box.left - 6, y(m) + 4); }
    pen.save(); pen.beginPath(); pen.rect(box.left, box.top, box.right - box.left, box.bottom - box.top); pen.clip();
    for (const vehicle of mine) {
      pen.lineWidth = vehicle.cv ? 2 : 1; pen.globalAlpha = vehicle.cv ? 1 : 0.7;
      const stride = Math.max(1, Math.floor(data.frames / width));
      for (let i = stride; i < vehicle.path.length && vehicle.path[i - stride] < near; i += stride) {
        pen.strokeStyle = paintOf(vehicle, (vehicle.path[i] - vehicle.path[i - stride]) / (stride * data.frame_s));
        follow(pen, [x(vehicle.first + i - stride), y(vehicle.path[i - stride]), x(vehicle.first + i), y(vehicle.path[i])]);
      }
    }
    pen.globalAlpha = 1; pen.restore();
    const index = approach * data.net.exits.length + mainExit(data.baseline, approach);
    episode.signals.forEach(([begin, colours], k) => {
      const end = Math.min(data.frames, episode.signals[k + 1]?.[0] ?? data.frames);
      pen.fillStyle = SIGNAL[colours[index]];
      pen.globalAlpha = colours[index] === "g" ? 0.55 : 1;
      pen.fillRect(x(begin), y(0) - (colours[index] === "g" ? 1 : 2.5), x(end) - x(begin), colours[index] === "g" ? 2 : 5);
    });
    return { picture, x, box };
  };

  const drawTimeSpace = side => {
    const canvas = byId(`${side}-timespace`), [pen, width, height] = prepare(canvas);
    const key = [width, height, root.dataset.theme, byId("paint").value, state.index].join();
    let kept = pictures.get(side);
    if (kept?.key !== key) { kept = { key, ...timeSpace(side, width, height, canvas.width / width) }; pictures.set(side, kept); }
    pen.drawImage(kept.picture, 0, 0, width, height);
    pen.strokeStyle = colourOf("--ink"); pen.lineWidth = 1.2;
    follow(pen, [kept.x(state.frame), kept.box.top, kept.x(state.frame), kept.box.bottom]);
  };

  const draw = () => {
    if (!state.scene) return;
    SIDES.forEach(side => { drawMap(side); drawTimeSpace(side); });
    byId("scrub").value = String(Math.round(state.frame));
    byId("clock").textContent = `${(state.frame * state.scene.frame_s).toFixed(0)} s`;
  };

  // -- controls -------------------------------------------------------------------------------------------------------

  const setPlaying = on => {
    state.playing = on;
    byId("play").textContent = on ? "Pause" : "Play";
    byId("play").setAttribute("aria-pressed", String(on));
    if (on) { state.last = performance.now(); if (state.frame >= state.scene.frames - 1) state.frame = 0; requestAnimationFrame(tick); }
  };

  const tick = now => {
    if (!state.playing) return;
    state.frame += Math.min(0.1, (now - state.last) / 1000) * Number(byId("rate").value) / state.scene.frame_s;
    state.last = now;
    if (state.frame >= state.scene.frames - 1) { state.frame = state.scene.frames - 1; setPlaying(false); }
    draw();
    requestAnimationFrame(tick);
  };

  /** Look at the stop line of the scored approach, and more at what comes than at what leaves. */
  const lookAtApproach = () => {
    const { net, approach } = state.scene, stop = net.stops.find(([, leg]) => leg === approach) ?? net.stops[0];
    const lane = net.lanes[stop[0]], [, , heading] = poseOn(lane, lane.n);
    state.span = 170;
    state.shift = [-Math.cos(heading) * 40, -Math.sin(heading) * 40];
  };

  const percent = value => { const text = value.toFixed(1); return Number(text) === 0 ? "0.0 %" : `${value > 0 ? "+" : ""}${text} %`; };
  const legend = () => {
    const swatch = (style, label) => { const item = document.createElement("span"), mark = document.createElement("i"); mark.style.background = style; mark.className = style.startsWith("linear") ? "ramp" : ""; item.append(mark, label); return item; };
    const ramp = `linear-gradient(90deg, ${Array.from({ length: 7 }, (_, k) => speedColour(k * FAST_MPS / 6)).join(",")})`;
    const items = byId("paint").value === "speed" ? [swatch(ramp, `standing to ${FAST_MPS} m/s`), "white rim and dot: controlled vehicle"] : [swatch(CV, "controlled"), swatch(HDV, "human")];
    byId("legend").replaceChildren(...items);
  };

  /** The moment at which most vehicles are within 80 m of the stop line, to begin with something to see. */
  const busiest = data => {
    const moments = Array.from({ length: Math.ceil(data.frames / 10) }, (_, k) => 10 * k);
    const near = frame => data.policy.vehicles.filter(v => {
      const x = v.path[frame - v.first];
      return v.approach === data.approach && x > -80 && x < 20;
    }).length;
    const counts = moments.map(near);
    return moments[counts.indexOf(Math.max(...counts))] ?? 0;
  };

  const show = async index => {
    setPlaying(false);
    if (!loaded.has(index)) loaded.set(index, decode(await unpack(`replay-pack-${index}`)));
    const scene = content.scenes[index], data = loaded.get(index);
    data.approach = Math.max(0, data.net.approaches.indexOf(scene.approach));
    Object.assign(state, { scene: data, index, frame: busiest(data) });
    lookAtApproach();
    const same = SIDES.every(side => data[side].as_evaluated) ? "" : " This replay differs from what was evaluated: the simulator or the machine is another one.";
    byId("scene-text").textContent = `${scene.context}: ${scene.policy} saves ${percent(scene.saved)} CO2 over uncommanded, mean over seeds. Seed ${scene.seed}.${same}`;
    const names = { baseline: `Baseline: ${scene.baseline}`, policy: scene.policy };
    SIDES.forEach(side => { byId(`${side}-name`).textContent = names[side]; byId(`${side}-ts-name`).textContent = names[side]; });
    byId("scrub").max = String(data.frames - 1);
    legend();
    draw();
    byId("replay-app").dataset.scene = String(index);
  };

  byId("play").addEventListener("click", () => setPlaying(!state.playing));
  byId("scrub").addEventListener("input", event => { state.frame = Number(event.target.value); draw(); });
  byId("paint").addEventListener("change", () => { legend(); draw(); });
  byId("closer").addEventListener("click", () => { state.span = Math.max(40, state.span / 1.5); draw(); });
  byId("farther").addEventListener("click", () => { state.span = Math.min(2500, state.span * 1.5); draw(); });
  SIDES.forEach(side => {
    const map = byId(`${side}-map`), diagram = byId(`${side}-timespace`);
    map.addEventListener("pointermove", event => {
      if (event.pointerType !== "mouse" || !(event.buttons & 1) || !state.scene) return;
      const box = map.getBoundingClientRect(), scale = Math.min(box.width, box.height * 1.2) / state.span;
      state.shift = [state.shift[0] - event.movementX / scale, state.shift[1] + event.movementY / scale];
      draw();
    });
    diagram.addEventListener("click", event => {
      const { box } = pictures.get(side), left = event.clientX - diagram.getBoundingClientRect().left;
      state.frame = Math.max(0, Math.min(1, (left - box.left) / (box.right - box.left))) * (state.scene.frames - 1);
      draw();
    });
  });
  new ResizeObserver(draw).observe(byId("replay-app"));
  themeListeners.push(draw);
  choices(byId("scenes"), content.scenes.map(s => `${s.policy}: ${s.which} (${percent(s.saved)})`), show);
});
