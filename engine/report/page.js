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
    for (const chart of document.querySelectorAll("svg.chart[data-from]")) {
      const { from, to, left, right } = chart.dataset;
      const x = +left + ((frame.t - from) / (to - from || 1)) * (right - left);
      const cursor = chart.querySelector(".cursor");
      cursor.setAttribute("x1", x);
      cursor.setAttribute("x2", x);
    }
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
    for (const chart of document.querySelectorAll("svg.chart[data-from]")) {
      chart.addEventListener("click", (event) => {
        const x = new DOMPoint(event.clientX, event.clientY).matrixTransform(chart.getScreenCTM().inverse()).x;
        const { from, to, left, right } = chart.dataset;
        const t = +from + ((x - left) / (right - left)) * (to - from);
        const far = frames.map((frame) => Math.abs(frame.t - t));
        show(far.indexOf(Math.min(...far)));
      });
    }
    show(0);
  }
})();
