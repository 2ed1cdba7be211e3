"use strict";
// Zoom and sliders for the charts of a page. Without this script, only these are missing.
function zoomable(svg) {
  const plot = svg.querySelector("svg.plot"), grid = svg.querySelector(".grid"), texts = svg.querySelector(".ticks");
  if (!plot || !grid || !texts || svg.nextElementSibling?.classList.contains("zoom")) return null;
  const numbers = (name) => svg.dataset[name].split(" ").map(Number);
  const whole = numbers("frame"), [left, top, width, height] = numbers("plot"), [px, py] = numbers("powers");
  const box = plot.viewBox.baseVal, full = [box.width, box.height], narrow = svg.classList.contains("narrow");
  const chart = { shown: () => {}, picked: () => {} };
  let view = whole.slice();

  function ticks(low, high, most, power) {
    const exponent = Math.floor(Math.log10((high - low) / most) + 1e-9);
    const size = [1, 2, 5, 10].find((s) => s * 10 ** exponent >= ((high - low) / most) * (1 - 1e-9));
    const step = size * 10 ** exponent, digits = Math.max(0, power - Math.floor(Math.log10(step) + 1e-9)), out = [];
    for (let k = Math.ceil(low / step - 1e-9); k <= high / step + 1e-9; k++) {
      out.push([k * step, ((k * step) / 10 ** power).toFixed(Math.min(digits, 12)).replace("-", "\u2212")]);
    }
    return out;
  }

  function add(parent, name, attributes, text) {
    const element = document.createElementNS(svg.namespaceURI, name);
    Object.entries(attributes).forEach(([key, value]) => element.setAttribute(key, value));
    if (text !== undefined) element.textContent = text;
    parent.appendChild(element);
    return element;
  }

  function show() {
    const [x0, x1, y0, y1] = view, spanX = whole[1] - whole[0], spanY = whole[3] - whole[2];
    plot.setAttribute("viewBox", [
      ((x0 - whole[0]) / spanX) * full[0], ((whole[3] - y1) / spanY) * full[1],
      ((x1 - x0) / spanX) * full[0], ((y1 - y0) / spanY) * full[1],
    ].join(" "));
    grid.replaceChildren();
    texts.replaceChildren();
    ticks(y0, y1, 5, py).forEach(([v, label]) => {
      const y = top + (height * (y1 - v)) / (y1 - y0);
      add(grid, "path", { d: `M${left} ${y}h${width}` });
      add(texts, "text", { x: left - 6, y: y + 4, "text-anchor": "end" }, label);
    });
    ticks(x0, x1, narrow ? 4 : 9, px).forEach(([v, label]) => {
      const x = left + (width * (v - x0)) / (x1 - x0);
      add(grid, "path", { d: `M${x} ${top}v${height}` });
      add(texts, "text", { x: x, y: top + height + 16, "text-anchor": "middle" }, label);
    });
    svg.dataset.view = view.join(" ");
    const zoomed = view.some((v, i) => v !== whole[i]);
    [out, back, on, all].forEach((b) => { b.disabled = !zoomed; });
    chart.shown();
  }

  function move(x0, x1, y0, y1) {
    const spanX = whole[1] - whole[0];
    if (!(x1 - x0 > spanX * 1e-4) || !(y1 - y0 > (whole[3] - whole[2]) * 1e-4)) return;
    const wide = Math.min(x1 - x0, spanX), start = Math.min(Math.max(x0, whole[0]), whole[1] - wide);
    view = [start, start + wide, Math.max(y0, whole[2]), Math.min(y1, whole[3])];
    show();
  }

  const figure = svg.parentElement, bar = document.createElement("div");
  bar.className = narrow ? "zoom narrow" : "zoom wide";
  bar.setAttribute("role", "group");
  bar.setAttribute("aria-label", "Zoom of " + svg.querySelector("title").textContent);
  function button(text, label, act) {
    const made = document.createElement("button");
    made.type = "button";
    made.textContent = text;
    made.setAttribute("aria-label", label);
    made.addEventListener("click", act);
    bar.appendChild(made);
    return made;
  }
  const scaled = (factor) => () => {
    const middle = (view[0] + view[1]) / 2, half = ((view[1] - view[0]) / 2) * factor;
    if (factor > 1 && 2 * half >= whole[1] - whole[0]) { view = whole.slice(); show(); return; }
    move(middle - half, middle + half, view[2], view[3]);
  };
  const shifted = (sign) => () => {
    const by = sign * (view[1] - view[0]) / 2;
    move(view[0] + by, view[1] + by, view[2], view[3]);
  };
  button("+", "Zoom in", scaled(0.5));
  const out = button("\u2212", "Zoom out", scaled(2)), back = button("\u2190", "Move left", shifted(-1));
  const on = button("\u2192", "Move right", shifted(1));
  const all = button("Whole", "Show the whole chart", () => { view = whole.slice(); show(); });
  figure.insertBefore(bar, svg.nextSibling);
  [out, back, on, all].forEach((b) => { b.disabled = true; });

  let from = null, mark = null;
  function at(event) {
    const rect = svg.getBoundingClientRect(), scale = svg.viewBox.baseVal.width / rect.width;
    const x = (event.clientX - rect.left) * scale, y = (event.clientY - rect.top) * scale;
    return [Math.min(Math.max(x, left), left + width), Math.min(Math.max(y, top), top + height)];
  }
  const toX = (v) => view[0] + ((v - left) / width) * (view[1] - view[0]);
  const toY = (v) => view[3] - ((v - top) / height) * (view[3] - view[2]);
  svg.addEventListener("pointerdown", function (event) {
    if (event.button !== 0) return;
    from = at(event);
    svg.setPointerCapture(event.pointerId);
    mark = add(svg, "rect", { class: "mark", x: from[0], y: top, width: 0, height: height });
  });
  svg.addEventListener("pointermove", function (event) {
    if (!from) return;
    const [x, y] = at(event), tall = event.pointerType === "mouse" && Math.abs(y - from[1]) > 24;
    mark.setAttribute("x", Math.min(x, from[0]));
    mark.setAttribute("width", Math.abs(x - from[0]));
    mark.setAttribute("y", tall ? Math.min(y, from[1]) : top);
    mark.setAttribute("height", tall ? Math.abs(y - from[1]) : height);
  });
  function end(event) {
    if (!from) return;
    const [x, y] = at(event), begun = from, tall = event.pointerType === "mouse" && Math.abs(y - begun[1]) > 24;
    from = null;
    mark.remove();
    if (event.type === "pointercancel") return;
    if (Math.abs(x - begun[0]) < 8) { chart.picked(toX(x)); return; }
    const ys = tall ? [toY(Math.max(y, begun[1])), toY(Math.min(y, begun[1]))] : [view[2], view[3]];
    move(toX(Math.min(x, begun[0])), toX(Math.max(x, begun[0])), ys[0], ys[1]);
  }
  svg.addEventListener("pointerup", end);
  svg.addEventListener("pointercancel", end);
  svg.addEventListener("dblclick", () => { view = whole.slice(); show(); });

  // Marks of the slider position: a vertical line across the plot, and a ring on every line of the chart.
  const cursor = add(svg, "g", { class: "cursor" });
  chart.point = (x, values) => {
    cursor.replaceChildren();
    if (x < view[0] || x > view[1]) return;
    const across = left + (width * (x - view[0])) / (view[1] - view[0]);
    add(cursor, "path", { d: `M${across} ${top}v${height}` });
    values.forEach(([y, style]) => {
      if (y === null || y < view[2] || y > view[3]) return;
      const down = top + (height * (view[3] - y)) / (view[3] - view[2]);
      add(cursor, "circle", { class: `line${style}`, cx: across, cy: down, r: 4.5 });
    });
  };
  // A zoomed section follows the slider.
  chart.follow = (x) => {
    const wide = view[1] - view[0];
    if (x < view[0] || x > view[1]) move(x - wide / 2, x + wide / 2, view[2], view[3]);
  };
  return chart;
}

let sliders = 0;
// A slider below a chart displays the values of its lines at one position, and their difference.
function slider(svg, charts) {
  const figure = svg.parentElement, told = JSON.parse(svg.dataset.readings), name = svg.querySelector("title").textContent;
  const times = told.at[1];
  // An integer and its power of ten are combined as text, so that 3 tenths are displayed as 0.3.
  const scaled = ([power, whole], k) => (whole[k] === null ? null : Number(`${whole[k]}e${power}`));
  const time = (k) => scaled(told.at, k), value = (i, k) => scaled(told.lines[i].at, k);
  function words(v, unit) {
    if (v === null) return "none";
    const [mantissa, power] = v.toExponential(3).split("e").map(Number);
    const raised = [...String(power)].map((c) => "\u207b\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079"["-0123456789".indexOf(c)]);
    const text = v === 0 || (power > -4 && power < 5) ? String(Number(v.toPrecision(4))) : `${mantissa}\u00d710${raised.join("")}`;
    return text.replace("-", "\u2212") + (unit && unit !== "1" ? `\u00a0${unit}` : "");
  }

  const row = document.createElement("div"), label = document.createElement("label"), range = document.createElement("input");
  const said = document.createElement("p");
  row.className = "slide";
  range.type = "range";
  range.id = `slide-${++sliders}`;
  Object.assign(range, { min: 0, max: times.length - 1, step: 1, value: told.begin });
  // The track lies below the horizontal axis; its ends extend it by half the thumb.
  figure.querySelectorAll("svg[data-plot]").forEach((drawing) => {
    const [left, , width] = drawing.dataset.plot.split(" ").map(Number), kind = drawing === svg ? "wide" : "narrow";
    const share = (v) => `${(100 * v) / drawing.viewBox.baseVal.width}%`;
    row.style.setProperty(`--left-${kind}`, share(left));
    row.style.setProperty(`--span-${kind}`, share(width));
  });
  label.htmlFor = range.id;
  label.textContent = told.name;
  range.setAttribute("aria-label", `${told.name}, ${name}`);
  said.className = "reads";
  row.append(label, range, said);
  figure.insertBefore(row, figure.querySelector(".note"));

  function show(follow) {
    const k = Number(range.value), parts = told.lines.map((line, i) => [line.name || "value", words(value(i, k), told.y)]);
    if (told.apart && value(0, k) !== null && value(1, k) !== null) {
      parts.push([k === told.begin ? "largest difference" : "difference", words(Math.abs(value(0, k) - value(1, k)), told.y)]);
    }
    parts.unshift([told.name, words(time(k), told.unit)]);
    said.replaceChildren(...parts.map(([what, text]) => {
      const part = document.createElement("span"), strong = document.createElement("b");
      text.split(/\^(-?[\w.]+)/).forEach((piece, i) => {
        const raised = i % 2 ? document.createElement("sup") : strong;
        raised.append(piece.replace("-", "\u2212"));
        if (i % 2) strong.append(raised);
      });
      part.append(`${what} `, strong);
      return part;
    }));
    range.setAttribute("aria-valuetext", parts.map(([what, text]) => `${what} ${text}`).join(", "));
    if (follow) charts.forEach((chart) => chart.follow(time(k)));
    charts.forEach((chart) => chart.point(time(k), told.lines.map((line, i) => [value(i, k), line.style])));
  }
  range.addEventListener("input", () => show(true));
  charts.forEach((chart) => {
    chart.shown = () => show(false);
    chart.picked = (x) => {
      let best = 0;
      times.forEach((_, k) => { if (Math.abs(time(k) - x) < Math.abs(time(best) - x)) best = k; });
      range.value = best;
      show(false);
    };
  });
  show(false);
}

function liven(root) {
  root.querySelectorAll("figure").forEach((figure) => {
    const charts = [...figure.querySelectorAll("svg.chart[data-frame]")].map(zoomable).filter(Boolean);
    const read = figure.querySelector("svg[data-readings]");
    if (read && charts.length) slider(read, charts);
  });
}
liven(document);
