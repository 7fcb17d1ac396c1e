"use strict";
// What the page of `vlc-rx serve` and the reports of `vlc-rx inspect` share. Whatever comes from outside is set as text.
const view = (() => {
  const words = { ok: "received", weak: "unsure", no_packet: "no packet", dark: "too dark" };

  function make(name, text, kind) {
    const node = document.createElement(name);
    if (text !== undefined && text !== null) node.textContent = text;
    if (kind) node.className = kind;
    return node;
  }

  function count(number, noun, nouns = `${noun}s`) { return `${number} ${number === 1 ? noun : nouns}`; }

  function folded(title, ...parts) {
    const node = make("details");
    node.append(make("summary", title), ...parts);
    return node;
  }

  // -- a picture with outlines over it ---------------------------------------------------------------------------
  const SVG = "http://www.w3.org/2000/svg";
  function shape(name, attributes, text) {
    const node = document.createElementNS(SVG, name);
    if (text !== undefined) node.textContent = text;
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    return node;
  }
  const at = (list) => list.map((point) => point.join(",")).join(" ");

  function draw(figure, picture, told) {
    if (!picture) { figure.replaceChildren(); return; }
    const view = make("div", null, "view");
    const image = make("img");
    image.src = `data:image/jpeg;base64,${picture.jpeg}`;
    image.alt = told;
    image.width = picture.width;
    image.height = picture.height;
    const over = shape("svg", { viewBox: `0 0 ${picture.width} ${picture.height}`, "aria-hidden": "true" });
    const many = picture.outlines.length > 24;
    for (const column of picture.outlines) {
      const polygon = over.appendChild(shape("polygon", { points: at(column.points), class: column.status }));
      polygon.append(shape("title", {}, `column ${column.column}: ${words[column.status]}`));
    }
    if (picture.corners.length) over.append(shape("polygon", { points: at(picture.corners), class: "corners" }));
    for (const column of picture.outlines.filter((one) => !many || one.column % 10 === 0)) {
      const x = column.points.reduce((sum, point) => sum + point[0], 0) / column.points.length;
      const y = column.points.reduce((most, point) => Math.max(most, point[1]), 0) - 10;
      over.append(shape("text", { x, y, "text-anchor": "middle", "font-size": picture.width / 70 }, column.column));
    }
    for (const [number, grid] of (picture.grids || []).entries()) {
      for (const line of grid.lines) over.append(shape("polyline", { points: at(line), class: `grid${number}` }));
    }
    view.append(image, over);
    figure.replaceChildren(view, make("figcaption", told));
  }

  function toldOf(columns) {
    if (!columns.length) return "The picture, without a screen that could be read.";
    const numbers = {};
    for (const column of columns) numbers[column.status] = (numbers[column.status] || 0) + 1;
    const parts = Object.keys(words).filter((key) => numbers[key]).map((key) => `${numbers[key]} ${words[key]}`);
    return `The screen's ${count(columns.length, "column")}: ${parts.join(", ")}.`;
  }

  // -- texts and files ---------------------------------------------------------------------------------------------
  function showTexts(place, texts) {
    for (const item of texts) {
      if (item.kind === "file") {
        const link = make("a", `${item.name} (${count(item.size, "byte")})`, "link");
        const bytes = Uint8Array.from(atob(item.base64), (letter) => letter.charCodeAt(0));
        link.href = URL.createObjectURL(new Blob([bytes], { type: "application/octet-stream" }));
        link.download = item.name;
        const line = make("p", "File: ");
        line.append(link);
        place.append(line);
      } else {
        place.append(make("blockquote", item.text)); // an address is shown, never opened
      }
    }
  }

  // Files of which parts have come.
  function underWay(files, advice) {
    return files.map((file) => {
      const line = make("p"), bar = make("progress");
      bar.value = file.share;
      bar.setAttribute("aria-label", "Part of the file that has come");
      line.append(bar, ` ${Math.floor(100 * file.share)} % of a file of about ${count(file.bytes, "byte")}. ${advice}`);
      return line;
    });
  }

  // -- packets ---------------------------------------------------------------------------------------------------
  // Title, kind of cell, text, and whether the packets have it.
  const cells = [
    ["Column", "number", (p) => p.column, () => true],
    ["Sure", "number", (p) => `${(Math.floor(p.confidence * 1000) / 10).toFixed(1)} %`, () => true],
    ["Seen", "number", (p) => (p.copies === null ? "" : p.copies.toFixed(2)), () => true],
    ["Wrong bits", "number", (p) => (p.errors === null ? "" : p.errors), (p) => p.errors !== null],
    ["Payload", "mono", (p) => p.payload, () => true],
  ];

  // A table of a photo's packets; a table for each burst of a clip, of which the first is open.
  function payloads(packets) {
    const bursts = new Map();
    for (const packet of packets) bursts.set(packet.burst, [...(bursts.get(packet.burst) || []), packet]);
    return [...bursts].map(([burst, list], place) => {
      if (burst === null) return table(list);
      const node = folded(`Burst ${burst} at ${list[0].time_s.toFixed(2)} s: ${count(list.length, "packet")}`, table(list));
      node.open = place === 0;
      return node;
    });
  }

  function table(packets) {
    const grid = make("table");
    const shown = cells.filter(([, , , has]) => packets.some(has));
    const head = make("tr");
    for (const [title, kind] of shown) {
      const cell = make("th", title, kind === "number" ? kind : "");
      cell.scope = "col";
      head.append(cell);
    }
    const top = make("thead");
    top.append(head);
    const body = make("tbody");
    for (const packet of packets) {
      const row = make("tr");
      for (const [title, kind, text] of shown) row.append(make("td", text(packet), title === "Sure" ? `${kind} ${packet.status}` : kind));
      body.append(row);
    }
    grid.append(top, body);
    return grid;
  }

  // Columns without a packet, by reason.
  function silent(columns) {
    const without = columns.filter((column) => column.message && !["ok", "weak"].includes(column.status));
    if (!without.length) return [];
    const list = make("ul");
    for (const reason of new Set(without.map((column) => column.message))) {
      const which = without.filter((column) => column.message === reason).map((column) => column.column);
      list.append(make("li", `Column${which.length > 1 ? "s" : ""} ${which.join(", ")}: ${reason}`));
    }
    return [make("h3", "Columns without a packet"), list];
  }

  // The colours that columns have in a picture.
  function legend(columns) {
    const list = make("ul", null, "legend");
    list.setAttribute("aria-label", "Colours of the columns");
    for (const [kind, word] of Object.entries(words)) {
      if (columns.some((column) => column.status === kind)) list.append(make("li", word, kind));
    }
    return list;
  }

  return { words, make, count, folded, shape, draw, toldOf, showTexts, underWay, payloads, silent, legend };
})();
