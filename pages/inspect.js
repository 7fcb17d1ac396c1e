"use strict";
// Draws the report of `vlc-rx inspect` from the data in the page; `rxcli.results.page` says what they are.
(() => {
  const { words, make, count, folded, shape, draw, toldOf, showTexts, payloads, silent, legend } = view;
  const data = JSON.parse(document.getElementById("data").textContent);
  const LEFT = 56, MANY = 24, PADDING = 34;
  let WIDTH = 0; // of the charts: as wide as there is room, so that all columns are in view and texts keep their size
  const percent = (share, digits = 0) => `${(100 * share).toFixed(digits)} %`;
  const last = (list) => list[list.length - 1];

  function section(title, hint, ...parts) {
    const node = make("section");
    node.append(make("h2", title), ...(hint ? [make("p", hint, "hint")] : []), ...parts);
    document.querySelector("main").append(node);
    return node;
  }

  // A drawing with a text for those who do not see it.
  function svg(height, told, shapes, width = WIDTH, kind = "") {
    const node = shape("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", class: kind, "aria-label": told });
    node.append(shape("title", {}, told), ...shapes);
    return node;
  }
  function wide(drawing) {
    const node = make("div", null, "wide");
    node.append(drawing);
    return node;
  }
  const chart = (title, height, shapes, told, caption) => section(title, `${told} ${caption}`, svg(height, told, shapes));
  const label = (x, y, text, anchor = "start", more = {}) => shape("text", { x, y, "text-anchor": anchor, ...more }, text);
  const bar = (x, y, width, height, kind, more = {}) => shape("rect", { x, y, width, height, class: kind, ...more });
  function titled(node, text) { node.append(shape("title", {}, text)); return node; }
  // Numbers of columns under a chart: all where there is room, else every fifth or tenth.
  const every = (step) => (step >= 18 ? 1 : step >= 5 ? 5 : 10);
  const numbers = (columns, step, y) => columns
    .map((column, place) => (column % every(step) === 0 ? label(50 + (place + 0.5) * step, y, column, "middle") : null))
    .filter(Boolean);

  function summary() {
    const steps = make("ol", null, "steps");
    steps.setAttribute("aria-label", "How far it came");
    let failed = false;
    for (const [name, good] of data.steps) {
      const kind = good ? "done" : failed ? "open" : "failed";
      failed ||= !good;
      const item = make("li", null, kind);
      const mark = make("span", { done: "✓", failed: "✗", open: "–" }[kind]);
      mark.setAttribute("aria-hidden", "true");
      const told = make("span", `: ${{ done: "done", failed: "failed here", open: "not reached" }[kind]}`, "visually-hidden");
      item.append(mark, ` ${name}`, told);
      steps.append(item);
    }
    const texts = make("div", null, "texts");
    showTexts(texts, data.texts);
    const facts = make("dl");
    for (const [name, value] of Object.entries(data.facts)) {
      const fact = make("div");
      fact.append(make("dt", name), make("dd", value));
      facts.append(fact);
    }
    const notes = [...data.notes.map((note) => make("p", note)), ...(data.advice ? [make("p", data.advice, "advice")] : [])];
    section(data.headline, "", texts, make("p", data.source, "hint"), steps, ...notes, facts);
  }

  function photo() {
    const figure = make("figure");
    const outlined = data.picture.outlines.length > 0;
    draw(figure, data.picture, outlined ? toldOf(data.columns) : "No columns could be outlined.");
    const caption = "White: the outline of the screen that was found. Colours: what became of each column of its backlight.";
    const node = section("The picture", outlined ? caption : "", figure, ...(outlined ? [legend(data.columns)] : []));
    for (const map of data.maps) {
      const inside = make("figure"), list = make("ul", null, "legend");
      draw(inside, map, map.text);
      for (const [number, grid] of (map.grids || []).entries()) {
        list.append(make("li", `Columns ${grid.pitch_px.toFixed(0)} pixels wide`, `grid${number}`));
      }
      node.append(folded(map.title, inside, make("p", map.caption, "hint"), list));
    }
  }

  function timeline() {
    const frames = data.timeline;
    if (frames.length < 2) return;
    const most = Math.max(1, ...frames.map((frame) => frame[3])), step = WIDTH / frames.length;
    const lost = frames.filter((frame) => !frame[4]).length;
    const shapes = frames.map(([number, time_s, headline, n, good], place) => {
      const group = titled(shape("g", {}), `frame ${number}, ${time_s.toFixed(2)} s: ${headline.toLowerCase()}`);
      const top = 100 - (90 * n) / most;
      group.append(bar(place * step, 100, step, 8, good ? "s-ok" : "s-no_packet"), bar(place * step, top, Math.max(step - 0.5, 0.5), 100 - top, "bar"));
      return group;
    });
    shapes.push(label(0, 124, `${frames[0][1].toFixed(2)} s`), label(WIDTH, 124, `${last(frames)[1].toFixed(2)} s`, "end"));
    const sum = frames.reduce((total, frame) => total + frame[3], 0);
    chart("The clip", 128, shapes, `${count(frames.length, "frame")}, ${count(sum, "packet")}, ${lost} frames without reception.`,
      `Height: packets that ended in a frame, ${most} at most. The line below is green where the frame was received.`);
  }

  function packets() {
    const parts = [...payloads(data.packets), ...silent(data.columns)];
    if (!parts.length) return;
    const scored = data.packets.some((packet) => packet.errors !== null);
    const hint = `Sure: probability that every bit is right. Seen: how often the packet is in view.${scored ? " Wrong bits: against the truth." : ""}`;
    section("Packets", hint, ...(data.texts.length ? [folded(`Payloads: ${count(data.packets.length, "packet")}`, ...parts)] : parts));
  }

  function path(xs, ys) {
    let text = "", pen = "M";
    ys.forEach((y, place) => {
      if (y === null) { pen = "M"; return; }
      text += `${pen}${xs[place].toFixed(1)} ${y.toFixed(1)}`;
      pen = "L";
    });
    return text;
  }

  function traces(known) {
    const rows = known.traces.flatMap((trace) => (trace.rows.length ? [trace.rows[0], last(trace.rows)] : []));
    if (!rows.length) return;
    const low = Math.min(...rows), high = Math.max(...rows), scale = (WIDTH - LEFT - 4) / Math.max(high - low, 1);
    const pitch = known.traces.length > MANY ? 34 : 58, height = pitch - 8;
    const x = (row) => LEFT + (row - low) * scale;
    const shapes = known.traces.flatMap((trace, place) => {
      const top = 6 + place * pitch, start = trace.rows[0], end = last(trace.rows);
      const drawn = [titled(label(44, top + height / 2 + 4, trace.column, "end"), `column ${trace.column}: ${words[trace.status]}`), bar(48, top, 3, height, `s-${trace.status}`)];
      if (!trace.rows.length) return drawn;
      const xs = trace.rows.map(x);
      const ys = (steps) => steps.map((value) => (value === null ? null : top + height * (1 - Math.min(value / 1000, 1.08))));
      const lit = trace.lit.filter(([a, b]) => b > start && a < end).map(([a, b]) => {
        const from = x(Math.max(a, start));
        return `M${from.toFixed(1)} ${top}H${x(Math.min(b, end)).toFixed(1)}v${height}H${from.toFixed(1)}z`;
      });
      const borders = trace.borders.filter((row) => x(row) >= LEFT).map((row) => `M${x(row).toFixed(1)} ${top - 2}v${height + 4}`);
      const paths = { slots: lit.join(""), light: path(xs, ys(trace.light)), model: path(xs, ys(trace.model)), border: borders.join("") };
      return [...drawn, ...Object.entries(paths).map(([kind, d]) => shape("path", { class: kind, d }))];
    });
    const total = 6 + known.traces.length * pitch + 22;
    shapes.push(label(50, total - 6, `row ${low.toFixed(0)}`), label(WIDTH, total - 6, `row ${high.toFixed(0)} of the sensor`, "end"));
    const told = `Light of ${count(known.traces.length, "column")} over the sensor's rows; a slot takes ${known.rows_per_slot.toFixed(2)} rows.`;
    section("Light and slots", `The light of each column from the first row of the picture to the last; a row is an instant. Shaded: slots that were decided to be lit. Green: the light that these slots should give; where it lies on the black line, the decision fits. Red dashes: a packet begins. ${told}`, svg(total, told, shapes));
  }

  // Histogram of slots and eye diagram.
  function clarity(known) {
    const width = Math.min(480, WIDTH), height = 240, [dark, lit] = known.histogram, bins = dark.length, step = width / bins;
    const low = -0.4, span = 2, most = Math.max(1, ...dark, ...lit);
    const marks = [[0, "dark"], [1, "lit"]].flatMap(([value, word]) => {
      const at = ((value - low) / span) * width;
      return [shape("path", { class: "axis", d: `M${at} 0v${height}` }), label(at, height + 16, word, "middle")];
    });
    const bars = [["unlit", dark], ["lit", lit]].flatMap(([kind, counts]) =>
      counts.map((n, place) => bar(place * step, height - (height * n) / most, step, (height * n) / most, kind)));
    const sum = (list) => list.reduce((total, value) => total + value, 0);
    const half = Math.ceil(((0.5 - low) / span) * bins);
    const all = sum(dark) + sum(lit), wrong = sum(dark.slice(half)) + sum(lit.slice(0, half));
    const told = `Light of dark (blue) and lit (orange) slots: ${percent(wrong / Math.max(all, 1), 1)} of ${all} values lie on the wrong side of the middle.`;
    const peak = Math.max(1, ...known.eye.flat()), wide_ = width / known.eye[0].length;
    const cells = known.eye.flatMap((row, y) => row.map((n, x) => (n / peak > 1e-3
      ? bar(x * wide_, height - ((y + 1) * height) / bins, wide_ + 0.3, height / bins + 0.3, "bar", { "fill-opacity": Math.sqrt(n / peak).toFixed(2) }) : null)).filter(Boolean));
    cells.push(label(0, height + 16, "0"), label(width / 2, height + 16, "1 slot", "middle"), label(width, height + 16, "2 slots", "end"));
    section("How clear slots are", "", make("h3", "Slot values"), svg(height + 22, told, [...marks, ...bars], width, "small"),
      make("p", `${told} The further apart, the surer.`, "hint"), ...driven(), make("h3", "Eye diagram"),
      svg(height + 22, "Eye diagram: how light and time within two slots meet.", cells, width, "small"),
      make("p", "All columns, folded over two slots, the picture's own brightness taken out. Open eyes between the traces mean that slots can be told apart; a long exposure closes them.", "hint"));
  }

  // How well each column is driven.
  function driven() {
    if (!data.quality.length) return [];
    const micro = (value) => (value === null ? "" : (1e6 * value).toFixed(1)), part = (value) => (value === null ? "" : percent(value));
    const shown = [["Column", (q) => q.column], ["SNR, dB", (q) => (q.snr_db === null ? "" : q.snr_db.toFixed(1))], ["Contrast", (q) => part(q.contrast)], ["Brightness", (q) => part(q.brightness)],
      ["Lit after dark", (q) => part(q.lit_after_dark)], ["Dark after lit", (q) => part(q.dark_after_lit)], ["Rise, µs", (q) => micro(q.rise_s)], ["Fall, µs", (q) => micro(q.fall_s)], ["Jitter, µs", (q) => micro(q.jitter_s)]];
    const grid = make("table"), head = make("tr"), rows = data.quality.map((quality) => {
      const row = make("tr");
      row.append(...shown.map(([, text]) => make("td", String(text(quality)), "number")));
      return row;
    });
    head.append(...shown.map(([title]) => make("th", title, "number")));
    grid.append(head, ...rows);
    return [folded("How well each column is driven", grid)];
  }

  function residuals(known) {
    const points = known.residuals;
    if (!points.length) return;
    const late = points.map((point) => Math.abs(point[1])).sort((a, b) => a - b);
    const reach = Math.max(0.25, late[Math.floor(0.98 * (late.length - 1))]);
    const rows = points.map((point) => point[0]), low = Math.min(...rows), span = Math.max(Math.max(...rows) - low, 1);
    const dots = points.map(([row, value]) => shape("circle", { class: "dot", r: 3, cx: 50 + ((row - low) / span) * (WIDTH - 60), cy: 100 - 90 * Math.max(-1, Math.min(1, value / reach)) }));
    const axis = [shape("path", { class: "axis", d: `M50 100H${WIDTH}` }), label(46, 104, "0", "end"), label(46, 20, `+${reach.toFixed(2)}`, "end"), label(46, 192, `-${reach.toFixed(2)}`, "end")];
    const rms = Math.sqrt(points.reduce((total, point) => total + point[1] ** 2, 0) / points.length);
    chart("Is the clock right?", 204, [...axis, ...dots], `Clock residuals of ${points.length} places: ${rms.toFixed(3)} slots root mean square.`,
      "Each dot: how much later than expected, in slots, the light of one column is around a row. Dots on the line mean that line delay, lens and clock fit; a slope means another line delay, a bow another lens.");
  }

  function crosstalk(known) {
    const beside = known.crosstalk.flatMap(([left, , right]) => [left, right]).filter((value) => value !== null);
    if (!beside.length) return;
    const step = (WIDTH - 60) / known.crosstalk.length, most = Math.max(0.1, ...beside.map(Math.abs));
    const bars = known.crosstalk.flatMap(([left, , right], place) => [["unlit", left], ["lit", right]].map(([kind, value], side) => {
      const height = (120 * Math.max(value || 0, 0)) / most;
      return bar(50 + (place + 0.1 + 0.4 * side) * step, 130 - height, 0.38 * step, height, kind);
    }));
    bars.push(...numbers(known.traces.map((trace) => trace.column), step, 146), label(46, 16, percent(most), "end"), shape("path", { class: "axis", d: `M50 130H${WIDTH}` }));
    const mean = beside.reduce((total, value) => total + value, 0) / beside.length;
    chart("Light of neighbours", 152, bars, `A neighbour's light is ${percent(mean)} of a column's own on average, ${percent(most)} at most.`,
      "Blue: how much of a column's light follows the slots of the column to its left; orange: to its right.");
  }

  function confidence() {
    if (!data.packets.length) return;
    const columns = data.columns.map((column) => column.column), step = (WIDTH - 60) / columns.length, height = 26;
    const mine = data.columns.map((column) => data.packets.filter((packet) => packet.column === column.column));
    const deep = Math.max(...mine.map((list) => list.length));
    const cells = data.columns.flatMap((column, place) => Array.from({ length: deep }, (_, number) => {
      const packet = mine[place][number], x = 50 + place * step, y = 4 + number * height;
      const cell = titled(bar(x, y, Math.max(step - 1, 0.5), height - 2, `s-${packet ? packet.status : column.status}`, { "fill-opacity": packet ? 0.25 + 0.75 * packet.confidence : 0.25 }),
        `column ${column.column}: ${packet ? packet.confidence.toFixed(4) : "none"}`);
      const number_ = packet && step >= 20 ? [label(x + step / 2, y + 16, Math.floor(packet.confidence * 100), "middle", { class: "on" })] : [];
      return [cell, ...number_];
    }).flat());
    const sure = data.packets.filter((packet) => packet.confidence >= 0.9).length;
    chart("Confidence", deep * height + 24, [...cells, ...numbers(columns, step, deep * height + 18)],
      `${count(data.packets.length, "packet")}; ${sure} with a confidence of 0.9 or more.`, `Columns across, packets downwards${step >= 20 ? "; numbers are percent" : ""}.`);
  }

  function encoder() {
    if (!data.denoiser) return;
    const { corrected, ...facts } = data.denoiser, grid = make("table");
    for (const [name, value] of Object.entries(facts)) {
      const row = make("tr"), head = make("th", name.replaceAll("_", " ")), text = typeof value === "number" ? String(+value.toPrecision(4)) : typeof value === "string" ? value : JSON.stringify(value);
      head.scope = "row";
      row.append(head, make("td", text.length <= 200 ? text : `${text.slice(0, 199)}…`));
      grid.append(row);
    }
    const kept = corrected.length ? `Its corrections were kept in column${corrected.length > 1 ? "s" : ""} ${corrected.join(", ")}.` : "None of its corrections were kept.";
    section("Auto-encoder", "A small network that cleans the slots of columns in doubt; corrections are kept where they leave less doubt.", make("p", kept), grid);
  }

  function search() {
    if (!data.search.length) return;
    const grid = make("table"), head = make("tr");
    head.append(...["hypothesis", "prior", "evidence", "score", "fate"].map((name) => make("th", name)));
    grid.append(head);
    for (const [hypothesis, ...numbers] of data.search) {
      const row = make("tr"), fate = numbers.pop();
      row.append(make("td", hypothesis), ...numbers.map((value) => make("td", value.toFixed(1))), make("td", fate));
      grid.append(row);
    }
    section("Search", "Every hypothesis that was tried. The score is 0.08 of the evidence, with what complete packets add, plus the log prior.", wide(grid));
  }

  function times() {
    const { total, ...stages } = data.times, names = Object.keys(stages), most = Math.max(1e-9, ...Object.values(stages));
    const told = total === undefined ? "" : `${total.toFixed(0)} ms in all.`, all = Math.min(480, WIDTH);
    const bars = names.flatMap((name, place) => {
      const y = 24 * place, width = ((all - 180) * stages[name]) / most;
      return [label(96, 18 + y, name, "end"), bar(104, 6 + y, width, 16, "bar"), label(110 + width, 18 + y, `${stages[name].toFixed(0)} ms`)];
    });
    const skipped = { no_screen: "packets, as there is no screen", no_packets: "refining, as there are no packets", dark_columns: "dark columns", certain_columns: "certain columns", tracking: "tracking" };
    const left = Object.entries(data.skipped).map(([name, n]) => `${skipped[name] || name}${n > 1 ? ` (${n})` : ""}`).join(", ");
    section("Time", told, ...(names.length ? [svg(24 * names.length + 8, `Time by stage: ${told}`, bars, all, "small")] : []),
      make("p", left ? `Left out: ${left}.` : "Nothing was left out."));
  }

  function drawAll() {
    const width = Math.max(280, document.querySelector("main").getBoundingClientRect().width - 2 * PADDING);
    if (Math.abs(width - WIDTH) < 1) return;
    WIDTH = width;
    document.querySelector("main").replaceChildren();
    for (const part of [summary, photo, timeline, packets]) part();
    if (data.inspection) traces(data.inspection);
    if (data.inspection && data.inspection.received) for (const part of [clarity, residuals, crosstalk]) part(data.inspection);
    for (const part of [confidence, encoder, search, times]) part();
  }

  drawAll();
  addEventListener("resize", drawAll);
})();
