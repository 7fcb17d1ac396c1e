"use strict";
// Sends files and shows what became of them; follows the live camera. Whatever comes from outside is set as text.
(() => {
  const $ = (id) => document.getElementById(id);
  const page = document.documentElement.dataset;
  const { make, count, draw, toldOf, showTexts, underWay, payloads, folded, silent, legend } = view;
  const largest = Number(page.largest), MOST_ROWS = 400, NEWEST = 12;

  // -- the result of a file --------------------------------------------------------------------------------------
  let saved = null;
  function about(answer) {
    if (answer.reason || answer.seconds === undefined) return "";
    const parts = [`Read in ${answer.seconds.toFixed(1)} s.`, `Screen: ${answer.screen || "unknown"}.`,
      `Camera: ${answer.camera || "unknown, estimated from the picture"}.`];
    if (answer.cut_short) parts.push("Only the beginning of the clip was read.");
    if (answer.mirrored) parts.push(answer.mirrored);
    return parts.join(" ");
  }

  function show(answer) {
    const columns = answer.columns || [];
    $("result-title").textContent = answer.partial ? `So far: ${answer.headline}` : answer.headline;
    $("reason").textContent = answer.reason || "";
    $("about").textContent = about(answer);
    $("advice").textContent = answer.advice || "";
    $("texts").replaceChildren();
    showTexts($("texts"), answer.texts || []);
    $("files").replaceChildren(...underWay(answer.files || [], "Film longer."));
    draw($("picture"), answer.picture, toldOf(columns));
    if (answer.picture && columns.length) $("picture").append(legend(columns));
    $("payloads").replaceChildren();
    if (answer.packets && answer.packets.length) {
      const more = answer.packets.length - MOST_ROWS;
      const hint = `Sure: how likely every bit is right. Seen: how often the packet is in view.${more > 0 ? ` ${more} more packets are in the details.` : ""}`;
      const parts = [make("p", hint, "hint"), ...payloads(answer.packets.slice(0, MOST_ROWS))];
      const title = `Payloads: ${count(answer.packets.length, "packet")}`;
      $("payloads").append(...(answer.texts.length ? [folded(title, ...parts)] : [make("h3", title), ...parts]));
    }
    $("payloads").append(...silent(columns));
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

  // -- the queue -------------------------------------------------------------------------------------------------
  // Files in the order in which they came: each has its file, its row in the list and, once it is read, its answer.
  const queue = [];
  let selected = null; // the entry that is shown; null: the newest that is read
  let chosen = false; // whether a person has chosen it
  let busy = false;
  let session = newSession();
  function newSession() { return Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) => byte.toString(16).padStart(2, "0")).join(""); }

  function add(files) {
    for (const file of files) {
      const entry = { file, answer: null, row: make("button", null, "entry"), state: make("span", "waiting", "state"), thumb: make("span", null, "thumb") };
      entry.row.type = "button";
      entry.row.disabled = true;
      entry.row.append(entry.thumb, make("span", file.name, "name"), entry.state);
      entry.row.addEventListener("click", () => { chosen = true; select(entry); });
      const item = make("li");
      item.append(entry.row);
      $("queue").append(item);
      thumbnail(entry);
      queue.push(entry);
    }
    $("file").value = "";
    if (!busy) work();
  }

  // A small picture of the file where the browser can show it, the kind of file where it cannot.
  async function thumbnail(entry) {
    entry.thumb.textContent = (entry.file.name.match(/[^.]{1,4}$/) || [""])[0].toUpperCase();
    try {
      const picture = await createImageBitmap(entry.file, { resizeHeight: 112, resizeQuality: "medium" });
      const canvas = make("canvas");
      canvas.width = picture.width;
      canvas.height = picture.height;
      canvas.getContext("2d").drawImage(picture, 0, 0);
      if (!entry.answer) entry.thumb.replaceChildren(canvas);
    } catch { /* a RAW file, HEIC or a clip: its picture comes with the answer */ }
  }

  function select(entry) {
    selected = entry;
    for (const other of queue) other.row.setAttribute("aria-current", other === entry);
    show(entry.answer);
  }

  const received = (answer) => Boolean(answer) && (answer.packets || []).length + (answer.texts || []).length > 0;

  function answered(entry, answer) {
    if (!queue.includes(entry)) return; // started over meanwhile
    entry.answer = answer;
    entry.row.disabled = false;
    entry.state.textContent = (answer.texts || []).length ? answer.texts.map((item) => item.text || item.name).join(", ") : answer.headline;
    entry.state.className = `state ${received(answer) ? "ok" : "no_packet"}`;
    if (answer.picture) {
      const image = make("img");
      image.src = `data:image/jpeg;base64,${answer.picture.jpeg}`;
      image.alt = "";
      entry.thumb.replaceChildren(image);
    }
    $("tip").hidden ||= received(answer);
    if (!chosen || selected === entry) select(entry);
    if (answer.together) together(answer.together);
  }

  // What the files of this page have given together; `files` are those under way.
  function together(files) {
    const read = queue.filter((entry) => received(entry.answer));
    const texts = new Set(read.flatMap((entry) => entry.answer.texts.map((item) => item.text || item.name)));
    $("together").hidden = queue.length < 2 && !files.length;
    $("together-state").textContent = "Photos sent from this page are combined: what one shows in part, another completes. "
      + `So far: ${count(read.length, "photo")}, ${count(texts.size, "text or file", "texts and files")}.`;
    $("together-files").replaceChildren(...underWay(files, "Send more photos."));
  }

  // What is being done, and for how long.
  let doing = "", since = 0;
  function tell(text) { doing = text; since = Date.now(); $("progress").textContent = text; }
  setInterval(() => { if (doing) $("progress").textContent = `${doing} ${Math.floor((Date.now() - since) / 1000)} s`; }, 5000);

  async function work() {
    busy = true;
    if (!queue.some((entry) => entry.answer && selected)) $("result").hidden = true;
    for (let entry; (entry = queue.find((one) => !one.answer || one.answer.partial));) {
      entry.state.textContent = "reading …";
      entry.state.classList.add("busy");
      const left = queue.filter((one) => !one.answer).length - 1;
      tell(`Searching ${entry.file.name} for a screen${left ? `, ${count(left, "file")} waiting` : ""} …`);
      answered(entry, await read(entry));
    }
    tell("");
    busy = false;
  }

  // Answers of a proxy between this page and its server.
  const away = ["The proxy of this page does not reach its server.", "Inform the operator of this page."];
  const REFUSED = {
    403: ["The proxy of this page refuses uploads.", "Inform the operator of this page."],
    404: ["The server was started anew, and its address has changed.", "Open the address that it shows now."],
    413: ["The file is larger than the proxy of this page lets pass.", "Send a smaller one, or have its operator raise that limit."],
    502: away, 503: away, 504: away,
  };
  const failed = (reason, advice) => ({ status: "unreadable", headline: "The file could not be read", reason, advice });

  // The answer for a file; while a clip is read, what is known so far is shown.
  async function read(entry) {
    if (entry.file.size > largest) return failed(`The file is larger than ${Math.floor(largest / 1048576)} MB.`, "Send a photo, or a shorter clip.");
    try {
      const headers = { "Content-Type": "application/octet-stream", "Accept": "application/x-ndjson, application/json", "X-Session": session };
      const response = await fetch("photo", { method: "POST", body: entry.file, headers });
      const type = response.headers.get("Content-Type") || "";
      if (!type.includes("json")) return failed(...(REFUSED[response.status] || [`The server answered with status ${response.status}.`, "Inform the operator of this page."]));
      if (!type.startsWith("application/x-ndjson")) return await response.json();
      return await lines(response, (answer) => {
        if (answer.status === "waiting") tell(`Waiting: ${count(answer.place, "picture")} before yours …`);
        else { answered(entry, answer); tell(`Reading the clip, ${count(answer.n_frames, "frame")} so far …`); }
      });
    } catch {
      return failed("The picture did not arrive.", "Check that this phone is still in the same network, and try again.");
    }
  }

  // A line of JSON for what is known of a clip so far, now and then, and one for the whole answer, which is returned.
  async function lines(response, partly) {
    const reader = response.body.getReader();
    const decoder = new TextDecoder();
    let text = "", answer = null;
    for (;;) {
      const { done, value } = await reader.read();
      text += done ? decoder.decode() : decoder.decode(value, { stream: true });
      const whole = text.split("\n");
      text = whole.pop();
      if (whole.length) {
        answer = JSON.parse(whole.pop());
        if (answer.partial) partly(answer);
      }
      if (done) break;
    }
    if (!answer || answer.partial) throw new Error("the answer broke off");
    return answer;
  }

  $("file").addEventListener("change", () => add([...$("file").files]));
  const drop = $("drop");
  for (const name of ["dragover", "dragleave", "drop"]) {
    drop.addEventListener(name, (event) => {
      event.preventDefault();
      drop.classList.toggle("over", name === "dragover");
      if (name === "drop") add([...event.dataTransfer.files]);
    });
  }
  $("again").addEventListener("click", () => {
    for (const entry of queue.splice(0)) entry.row.parentNode.remove();
    session = newSession();
    selected = null;
    chosen = false;
    $("result").hidden = $("together").hidden = true;
    $("file").focus();
  });

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
      while (list.children.length > NEWEST) list.lastChild.remove();
    };
  }
  if (page.live === "yes") follow();
})();
