"use strict";
// Sends a photo and shows what became of it; follows the live camera. Whatever comes from outside is set as text.
(() => {
  const $ = (id) => document.getElementById(id);
  const page = document.documentElement.dataset;
  const { make, draw, toldOf, showTexts, table, silent } = view;
  const largest = Number(page.largest);

  // -- the result of a photo -----------------------------------------------------------------------------------
  let saved = null;
  function show(answer) {
    const columns = answer.columns || [];
    $("result-title").textContent = answer.partial ? `So far: ${answer.headline}` : answer.headline;
    $("reason").textContent = answer.reason || (answer.seconds !== undefined
      ? `Read in ${answer.seconds.toFixed(1)} s. Screen: ${answer.screen || "unknown"}. Camera: ${answer.camera || "unknown, estimated from the picture"}.${answer.cut_short ? " Only the beginning of the clip was read." : ""}${answer.mirrored ? ` ${answer.mirrored}` : ""}` : "");
    $("advice").textContent = answer.advice || "";
    $("texts").replaceChildren();
    showTexts($("texts"), answer.texts || []);
    draw($("picture"), answer.picture, toldOf(columns));
    $("legend").hidden = !columns.length;
    $("payloads").replaceChildren();
    if (answer.packets && answer.packets.length) {
      const more = answer.packets.length - 400;
      const caption = `Payload of each column (hex), and how sure it is${more > 0 ? `; ${more} more in the details` : ""}`;
      const grid = table(answer.packets.slice(0, 400), caption);
      if ((answer.texts || []).length) {
        const folded = make("details");
        folded.append(make("summary", "Payloads as they came"), grid);
        $("payloads").append(folded);
      } else $("payloads").append(grid);
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
        if (answer.status === "waiting") $("progress").textContent = `Waiting: ${count(answer.place, "picture")} before yours …`;
        else show(answer);
        if (answer.partial && answer.status !== "waiting") $("progress").textContent = "Reading the rest of the clip …";
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
