"use strict";
(() => {
  const { frames, box } = JSON.parse(document.getElementById("data").textContent);
  const at = (id) => document.getElementById(id);
  const SVG = "http://www.w3.org/2000/svg";
  const make = (name, attributes, space) => {
    const node = space ? document.createElementNS(space, name) : document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    return node;
  };
  const say = (name, text, kind) => {
    const node = make(name, kind ? { class: kind } : {});
    node.textContent = text;
    return node;
  };

  // ---- the map: buttons, Ctrl and the wheel, and dragging once it is zoomed
  const map = at("map");
  let view = [...box];
  const look = (next) => {
    const width = Math.min(Math.max(next[2], box[2] / 60), box[2]), height = (width * box[3]) / box[2];
    const keep = (value, low, room) => Math.min(Math.max(value, low), low + room);
    view = [keep(next[0], box[0], box[2] - width), keep(next[1], box[1], box[3] - height), width, height];
    map.setAttribute("viewBox", view.join(" "));
    map.classList.toggle("zoomed", width < box[2]);
  };
  const zoom = (factor, x = view[0] + view[2] / 2, y = view[1] + view[3] / 2) =>
    look([x - (x - view[0]) * factor, y - (y - view[1]) * factor, view[2] * factor]);
  const place = (event) => {
    const p = new DOMPoint(event.clientX, event.clientY).matrixTransform(map.getScreenCTM().inverse());
    return [p.x, p.y];
  };
  if (map) {
    at("zoom-in").onclick = () => zoom(0.6, ...(now().xy || []));
    at("zoom-out").onclick = () => zoom(1 / 0.6);
    at("zoom-all").onclick = () => look(box);
    map.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && !event.metaKey) return;
      event.preventDefault();
      zoom(event.deltaY < 0 ? 0.8 : 1.25, ...place(event));
    }, { passive: false });
    let grip = null, moved = false;
    map.addEventListener("pointerdown", (event) => { grip = place(event); moved = false; });
    map.addEventListener("pointermove", (event) => {
      if (!grip || !event.buttons || view[2] >= box[2]) return;
      const [x, y] = place(event);
      moved = true;
      look([view[0] + grip[0] - x, view[1] + grip[1] - y, view[2]]);
    });
    map.addEventListener("click", (event) => {
      const [x, y] = place(event);
      const far = frames.map((f) => (f.xy ? Math.hypot(f.xy[0] - x, f.xy[1] - y) : Infinity));
      if (!moved && frames.length) show(far.indexOf(Math.min(...far)));
    });
  }

  // ---- the charts: one time axis, zoomed by dragging across a chart, by buttons, or by Ctrl and the wheel
  const charts = [...document.querySelectorAll("svg.chart[data-from]")].map((node) => {
    const { from, to, left, right } = node.dataset;
    return { node, left: +left, width: right - left, whole: [+from, +to] };
  });
  let span = charts.length ? [...charts[0].whole] : [0, 1];
  const xOf = (chart, t) => chart.left + ((t - span[0]) / (span[1] - span[0] || 1)) * chart.width;
  const timeAt = (chart, event) => {
    const x = new DOMPoint(event.clientX, event.clientY).matrixTransform(chart.node.getScreenCTM().inverse()).x;
    return span[0] + Math.min(Math.max((x - chart.left) / chart.width, 0), 1) * (span[1] - span[0]);
  };
  const ticks = (low, high) => { // round ones, about six, as on the whole axis
    const rough = (high - low) / 6, power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 2.5, 5, 10].map((m) => m * power).find((s) => s >= rough * 0.999);
    const decimals = Math.min(6, [...Array(12).keys()].find((n) => Math.abs(+step.toFixed(n) - step) < 1e-6 * step));
    const form = { minimumFractionDigits: decimals, maximumFractionDigits: decimals };
    const values = [];
    for (let n = Math.ceil(low / step - 1e-9); n * step <= high + 1e-9 * step; n++) values.push(n * step || 0);
    return values.map((value) => [value, value.toLocaleString("en", form)]);
  };
  const relabel = (chart) => {
    const old = chart.node.querySelector(".x-grid"), [line, text] = [old.querySelector("line"), old.querySelector("text")];
    const [top, foot, below] = [line.getAttribute("y1"), line.getAttribute("y2"), text.getAttribute("y")];
    old.replaceChildren(...ticks(...span).flatMap(([value, name], i) => {
      const x = xOf(chart, value);
      const label = make("text", { class: `tick${i % 2}`, x, y: below, "text-anchor": "middle" }, SVG);
      label.textContent = name;
      return [make("line", { class: "grid", x1: x, x2: x, y1: top, y2: foot }, SVG), label];
    }));
  };
  const lookAt = (low, high) => {
    if (!charts.length) return;
    const [first, last] = charts[0].whole, least = (last - first) / 1000;
    const length = Math.min(Math.max(high - low, least), last - first);
    const begin = Math.min(Math.max(low, first), last - length);
    span = [begin, begin + length];
    for (const chart of charts) {
      const scale = (last - first || 1) / (length || 1);
      const shift = chart.left - scale * (chart.left + ((begin - first) / (last - first || 1)) * chart.width);
      chart.node.querySelector(".data").setAttribute("transform", `translate(${shift} 0) scale(${scale} 1)`);
      chart.node.classList.toggle("zoomed", length < last - first);
      if (last > first) relabel(chart);
      if (frames.length) moveCursor(chart, now().t);
    }
    const digits = length < 10 ? 2 : length < 100 ? 1 : 0;
    at("time-span").textContent = span.map((t) => t.toFixed(digits)).join(" to ");
  };
  const zoomTime = (factor, about) =>
    lookAt(about - (about - span[0]) * factor, about + (span[1] - about) * factor);
  const moveCursor = (chart, t) => {
    const cursor = chart.node.querySelector(".cursor"), x = t < span[0] || t > span[1] ? -999 : xOf(chart, t);
    cursor.setAttribute("x1", x);
    cursor.setAttribute("x2", x);
  };
  const follow = (t) => { // the frame that is shown stays in view
    const length = span[1] - span[0];
    if (t < span[0] || t > span[1]) lookAt(t - length / 2, t + length / 2);
    for (const chart of charts) moveCursor(chart, t);
  };
  const chosen = make("rect", { class: "chosen" }, SVG);
  for (const chart of charts) {
    let grip = null;
    const end = () => { grip = null; chosen.remove(); };
    chart.node.addEventListener("pointerdown", (event) => { grip = [timeAt(chart, event), event.clientX]; });
    chart.node.addEventListener("pointermove", (event) => {
      if (!grip || !event.buttons || Math.abs(event.clientX - grip[1]) < 6) return;
      if (!chart.node.hasPointerCapture(event.pointerId)) chart.node.setPointerCapture(event.pointerId);
      const [x0, x1] = [grip[0], timeAt(chart, event)].map((t) => xOf(chart, t)).sort((a, b) => a - b);
      const plot = chart.node.querySelector(".plot");
      const box = { x: x0, width: x1 - x0, y: plot.getAttribute("y"), height: plot.getAttribute("height") };
      for (const [key, value] of Object.entries(box)) chosen.setAttribute(key, value);
      chart.node.append(chosen);
    });
    chart.node.addEventListener("pointerup", (event) => {
      if (!grip) return;
      const [t0, x0] = grip, t1 = timeAt(chart, event);
      end();
      if (Math.abs(event.clientX - x0) >= 6) lookAt(Math.min(t0, t1), Math.max(t0, t1));
      else if (frames.length) {
        const far = frames.map((frame) => Math.abs(frame.t - t1));
        show(far.indexOf(Math.min(...far)));
      }
    });
    chart.node.addEventListener("pointercancel", end);
    chart.node.addEventListener("dblclick", () => lookAt(...chart.whole));
    chart.node.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && !event.metaKey) return;
      event.preventDefault();
      zoomTime(event.deltaY < 0 ? 0.8 : 1.25, timeAt(chart, event));
    }, { passive: false });
  }
  if (charts.length) {
    const middle = () => {
      const t = now().t;
      return t >= span[0] && t <= span[1] ? t : (span[0] + span[1]) / 2;
    };
    at("time-in").onclick = () => zoomTime(0.5, middle());
    at("time-out").onclick = () => zoomTime(2, middle());
    at("time-all").onclick = () => lookAt(...charts[0].whole);
  }

  // ---- several runs: each may be hidden
  for (const box of document.querySelectorAll("input[data-run]")) {
    box.onchange = () => {
      for (const mark of document.querySelectorAll(`.run${box.dataset.run}`)) mark.classList.toggle("hidden", !box.checked);
    };
  }

  // ---- the frames
  let current = 0;
  const now = () => frames[current] || {};
  const slider = at("slider");
  const figure = (picture) => {
    const aspect = picture.w / picture.h; // beside each other they are of one height
    const node = make("figure", { style: `flex: ${aspect} 1 ${150 * aspect}px; max-width: ${430 * aspect}px` });
    const svg = make("svg", { viewBox: `0 0 ${picture.w} ${picture.h}`, role: "img", "aria-label": picture.a }, SVG);
    svg.append(make("image", { href: picture.s, width: picture.w, height: picture.h }, SVG));
    const marks = make("g", {}, SVG);
    marks.innerHTML = picture.o; // our own shapes: numbers and nothing else
    svg.append(marks);
    node.append(svg, say("figcaption", picture.c));
    return node;
  };
  const show = (index) => {
    current = Math.min(Math.max(index, 0), frames.length - 1);
    const frame = now();
    slider.value = current;
    slider.setAttribute("aria-valuetext", `${frame.name}: ${frame.answer}`);
    [...at("strip").children].forEach((cell, i) => cell.classList.toggle("here", i === current));
    const facts = make("dl", {});
    for (const [name, value] of frame.facts) {
      const pair = make("div", {});
      pair.append(say("dt", name), say("dd", value));
      facts.append(pair);
    }
    at("facts").replaceChildren(say("h3", frame.name), say("p", frame.answer, `answer ${frame.kind}`),
      ...(frame.detail ? [say("p", frame.detail, "hint")] : []), facts);
    at("pictures").replaceChildren(...frame.pictures.map(figure));
    follow(frame.t);
    if (!map) return;
    at("now").setAttribute("d", frame.xy ? `M${frame.xy.join(" ")}h0` : "");
    const [x, y, width, height] = frame.window || [0, 0, 0, 0];
    for (const [key, value] of Object.entries({ x, y, width, height })) at("now-window").setAttribute(key, value);
  };
  if (frames.length) {
    slider.max = frames.length - 1;
    slider.oninput = () => show(+slider.value);
    at("before").onclick = () => show(current - 1);
    at("after").onclick = () => show(current + 1);
    frames.forEach((frame, i) => {
      const cell = make("i", { class: frame.kind, title: frame.name });
      cell.onclick = () => show(i);
      at("strip").append(cell);
    });
    document.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (!step || event.target === slider || event.ctrlKey || event.altKey || event.metaKey) return;
      event.preventDefault();
      show(current + step);
    });
    for (const button of document.querySelectorAll("[data-goto]")) {
      button.onclick = () => {
        show(+button.dataset.goto);
        at("frames").scrollIntoView();
        slider.focus({ preventScroll: true });
      };
    }
  }
  if (charts.length) lookAt(...span);
  if (frames.length) show(0);
})();
