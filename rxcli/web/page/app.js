"use strict";
// Sends a photo and shows what became of it; follows the live camera. Whatever comes from outside is set as text.
(() => {
  const $ = (id) => document.getElementById(id);
  const page = document.documentElement.dataset;
  const words = { ok: "received", weak: "unsure", no_packet: "no packet", dark: "too dark" };
  const largest = Number(page.largest);

  function make(name, text, kind) {
    const node = document.createElement(name);
    if (text !== undefined && text !== null) node.textContent = text;
    if (kind) node.className = kind;
    return node;
  }

  function count(number, noun) { return `${number} ${noun}${number === 1 ? "" : "s"}`; }

  // -- a picture with outlines over it ---------------------------------------------------------------------------
  const SVG = "http://www.w3.org/2000/svg";
  function shape(name, attributes) {
    const node = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    return node;
  }
  const path = (points) => points.map((point) => point.join(",")).join(" ");

  function draw(figure, picture, told) {
    if (!picture) { figure.replaceChildren(); return; }
    const view = make("div", null, "view");
    const image = make("img");
    image.src = `data:image/jpeg;base64,${picture.jpeg}`;
    image.alt = told;
    image.width = picture.width;
    image.height = picture.height;
    const over = shape("svg", { viewBox: `0 0 ${picture.width} ${picture.height}`, "aria-hidden": "true" });
    for (const column of picture.outlines) {
      over.append(shape("polygon", { points: path(column.points), class: column.status }));
    }
    if (picture.corners.length) over.append(shape("polygon", { points: path(picture.corners), class: "corners" }));
    if (picture.outlines.length && picture.outlines.length <= 24) {
      for (const column of picture.outlines) {
        const x = column.points.reduce((sum, point) => sum + point[0], 0) / column.points.length;
        const y = column.points.reduce((most, point) => Math.max(most, point[1]), 0) - 10;
        const label = shape("text", { x, y, "text-anchor": "middle", "font-size": picture.width / 70 });
        label.textContent = column.column;
        over.append(label);
      }
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

  // -- the result of a photo -----------------------------------------------------------------------------------
  function table(answer) {
    const rows = answer.packets.slice(0, 400);
    const whole = make("div", null, "scroll");
    whole.tabIndex = 0;
    const grid = make("table");
    const more = answer.packets.length - rows.length;
    grid.append(make("caption", `Payload of each column (hex), and how sure it is${more > 0 ? `; ${more} more in the details` : ""}`));
    const head = make("tr");
    for (const [title, kind] of [["Column", "number"], ["Sure", "number"], ["Payload", ""]]) {
      const cell = make("th", title, kind);
      cell.scope = "col";
      head.append(cell);
    }
    const top = make("thead");
    top.append(head);
    const body = make("tbody");
    for (const packet of rows) {
      const row = make("tr");
      row.append(make("td", packet.column, "number"),
        make("td", `${(Math.floor(packet.confidence * 1000) / 10).toFixed(1)} %`, `number ${packet.status}`),
        make("td", packet.payload, "mono"));
      body.append(row);
    }
    grid.append(top, body);
    whole.append(grid);
    return whole;
  }

  let saved = null;
  function show(answer) {
    const columns = answer.columns || [];
    $("result-title").textContent = answer.partial ? `So far: ${answer.headline}` : answer.headline;
    $("reason").textContent = (answer.reason || "").replace(/^No screen found: (.)/, (_, letter) => letter.toUpperCase()) || (answer.seconds !== undefined
      ? `Read in ${answer.seconds.toFixed(1)} s. Screen: ${answer.screen || "unknown"}. Camera: ${answer.camera || "unknown, estimated from the picture"}.${answer.cut_short ? " Only the beginning of the clip was read." : ""}${answer.mirrored ? ` ${answer.mirrored}` : ""}` : "");
    $("advice").textContent = answer.advice || "";
    $("texts").replaceChildren();
    showTexts($("texts"), answer.texts || []);
    draw($("picture"), answer.picture, toldOf(columns));
    $("legend").hidden = !columns.length;
    $("payloads").replaceChildren();
    if (answer.packets && answer.packets.length) $("payloads").append(table(answer));
    const reasons = [...new Set(columns.filter((column) => column.message && !["ok", "weak"].includes(column.status)).map((column) => column.message))];
    if (reasons.length) {
      const list = make("ul");
      for (const reason of reasons.slice(0, 6)) {
        const which = columns.filter((column) => column.message === reason).map((column) => column.column);
        list.append(make("li", `Column${which.length > 1 ? "s" : ""} ${which.join(", ")}: ${reason}`));
      }
      $("payloads").append(make("h3", "Columns without a packet"), list);
    }
    if (saved) URL.revokeObjectURL(saved);
    $("save").hidden = !answer.record;
    if (answer.record) {
      saved = URL.createObjectURL(new Blob([JSON.stringify({ packets: answer.packets, frame: answer.record }, null, 1)], { type: "application/json" }));
      $("save").href = saved;
    }
    const first = $("result").hidden;
    $("result").hidden = false;
    if (!first) return; // what is added to a clip's answer moves nobody who reads it
    $("result-title").focus();
    $("result").scrollIntoView({ block: "start" });
  }

  // A line of JSON for what is known of a clip so far, now and then, and one for the whole answer.
  async function showLines(response) {
    const reader = response.body.getReader();
    const decoder = new TextDecoder();
    let text = "", whole = null;
    for (;;) {
      const { done, value } = await reader.read();
      text += done ? decoder.decode() : decoder.decode(value, { stream: true });
      const lines = text.split("\n");
      text = lines.pop();
      if (lines.length) {
        const answer = JSON.parse(lines.pop());
        show(answer);
        if (answer.partial) $("progress").textContent = "Reading the rest of the clip …";
        whole = answer;
      }
      if (done) break;
    }
    if (!whole || whole.partial) throw new Error("the answer broke off");
  }

  async function send(file) {
    const progress = $("progress");
    if (file.size > largest) {
      show({ status: "unreadable", headline: "The file could not be read", reason: `The file is larger than ${Math.floor(largest / 1048576)} MB.`, advice: "Send a photo, or a shorter clip." });
      return;
    }
    progress.textContent = "Sending and reading the picture …";
    progress.classList.add("busy");
    $("result").hidden = true;
    try {
      const headers = { "Content-Type": "application/octet-stream", "Accept": "application/x-ndjson, application/json" };
      const answer = await fetch("photo", { method: "POST", body: file, headers });
      if (answer.headers.get("Content-Type").startsWith("application/x-ndjson")) await showLines(answer);
      else show(await answer.json());
    } catch (error) {
      show({ status: "unreadable", headline: "The file could not be read", reason: "The picture did not arrive.", advice: "Check that this phone is still in the same network, and try again." });
    } finally {
      progress.textContent = "";
      progress.classList.remove("busy");
      $("file").value = "";
    }
  }

  $("file").addEventListener("change", () => { if ($("file").files.length) send($("file").files[0]); });
  const drop = $("drop");
  for (const name of ["dragover", "dragleave", "drop"]) {
    drop.addEventListener(name, (event) => {
      event.preventDefault();
      drop.classList.toggle("over", name === "dragover");
      if (name === "drop" && event.dataTransfer.files.length) send(event.dataTransfer.files[0]);
    });
  }

  // -- the live camera -----------------------------------------------------------------------------------------
  function put(id, text) { if ($(id).textContent !== text) $(id).textContent = text; }

  function follow() {
    $("live").hidden = false;
    const events = new EventSource("live");
    events.onerror = () => { put("lock", "waiting"); $("lock").className = "lock waiting"; put("aim", "The page has lost its connection and tries again."); };
    events.onmessage = (message) => {
      const event = JSON.parse(message.data);
      if (event.problem) { put("lock", "no camera"); $("lock").className = "lock waiting"; put("aim", event.problem); return; }
      if (event.texts) showTexts($("live-texts"), event.texts);
      if (!event.state) return;
      const state = event.state;
      put("lock", state.word);
      $("lock").className = `lock ${state.locked ? "locked" : "waiting"}`;
      put("aim", [state.reason, state.advice].filter(Boolean).join(" "));
      put("m-columns", state.n_columns ? `${state.n_received} of ${state.n_columns}` : "–");
      put("m-packets", state.packets_per_s.toFixed(0));
      put("m-rate", `${(state.bits_per_s / 1000).toFixed(1)} kb/s`);
      put("m-light", event.light || "–");
      put("m-height", state.height_share === null ? "–" : `${Math.floor(state.height_share * 100)} %`);
      put("m-frames", state.frames_per_s.toFixed(1));
      draw($("live-picture"), event.picture, state.locked ? "The camera's picture, with the screen's columns." : "The camera's picture.");
      const list = $("live-packets");
      for (const packet of event.packets) list.prepend(make("li", `column ${packet.column}: ${packet.payload}`));
      while (list.children.length > 60) list.lastChild.remove();
    };
  }
  if (page.live === "yes") follow();
})();
