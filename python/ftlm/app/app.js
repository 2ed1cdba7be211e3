// The page requests parts of its HTML from its own server and inserts them. The server escapes all text of files and users.
const $ = (id) => document.getElementById(id);
const said = $("said"), ask = $("ask"), files = $("files"), models = $("models");
const most = Number(document.body.dataset.most);

let silence = 0;
function say(words, bad) {
  said.textContent = words;
  said.classList.toggle("bad", Boolean(bad));
  clearTimeout(silence);
  // An error message stays until the next message.
  if (!bad) silence = setTimeout(() => { said.textContent = ""; }, 6000);
}

async function request(path, options) {
  let answer;
  try {
    answer = await fetch(path, options);
  } catch {
    throw new Error("ftlm app does not answer: it was ended in its terminal, or cut the request off");
  }
  const text = await answer.text();
  if (answer.ok) return text;
  let words = text;
  try { words = JSON.parse(text).error; } catch { /* the text is not JSON and is shown unchanged */ }
  throw new Error(words || `refused (${answer.status})`);
}

const send = (path, body) => request(path, {
  method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body),
});

// Replace the element of the same id by a new one, or insert it first. Open details and the focus are kept.
function put(parent, html, first) {
  const made = document.createElement("template");
  made.innerHTML = html;
  const part = made.content.firstElementChild, old = document.getElementById(part.id);
  if (!old) {
    if (first) parent.prepend(part); else parent.append(part);
    liven(part);
    return part;
  }
  const focus = old.contains(document.activeElement) ? document.activeElement.name : "";
  const open = new Map([...old.querySelectorAll("details")].map((d) => [d.querySelector("summary").textContent, d.open]));
  part.querySelectorAll("details").forEach((d) => {
    const was = open.get(d.querySelector("summary").textContent);
    if (was !== undefined) d.open = was;
  });
  old.replaceWith(part);
  liven(part);
  if (focus) part.querySelector(`[name="${CSS.escape(focus)}"]`)?.focus();
  return part;
}

// ------------------------------------------------------------------------------------------------------------ files

async function upload(list) {
  for (const file of list) {
    if (file.size > most) {
      say(`“${file.name}” is larger than ${most / 1048576} MB, the most that the page takes; load it in Python, or take fewer rows`, true);
      continue;
    }
    say(`Reading “${file.name}” …`);
    try {
      const html = await request(`files?name=${encodeURIComponent(file.name)}`, {
        method: "POST", headers: { "content-type": "application/octet-stream" }, body: file,
      });
      const part = put(files, html);
      if (part.dataset.version !== "0") say(`“${file.name}” is read.`);
      part.scrollIntoView({ block: "nearest" });
    } catch (error) {
      say(error.message, true);
    }
    arrange();
  }
}

$("pick").addEventListener("change", (event) => {
  upload([...event.target.files]).then(() => { event.target.value = ""; });
});
const drop = $("drop");
for (const kind of ["dragover", "dragenter"]) {
  document.addEventListener(kind, (event) => { event.preventDefault(); drop.classList.add("over"); });
}
document.addEventListener("dragleave", (event) => { if (!event.relatedTarget) drop.classList.remove("over"); });
document.addEventListener("drop", (event) => {
  event.preventDefault();
  drop.classList.remove("over");
  upload([...event.dataTransfer.files]);
});

// Values of the form fields of a file. A new layout may have other columns, so the columns are then omitted.
function fieldValues(card, layout) {
  const form = card.querySelector("form"), out = Object.fromEntries(new FormData(form));
  for (const name of Object.keys(out)) if (/-\d+$/.test(name)) delete out[name];
  if (!layout && card.querySelector("[data-column]")) {
    out.columns = [...card.querySelectorAll("[data-column]")].map((row) => ({
      name: row.dataset.column,
      ...Object.fromEntries([...row.querySelectorAll("[data-field]")].map((field) => [field.dataset.field, field.value])),
    }));
  }
  return out;
}

files.addEventListener("change", async (event) => {
  const card = event.target.closest(".file");
  say("Reading again …");
  card.setAttribute("aria-busy", "true");
  try {
    put(files, await send(`files/${card.dataset.key}`, fieldValues(card, "layout" in event.target.dataset)));
    say("Read again.");
  } catch (error) {
    say(error.message, true);
  }
  card.removeAttribute("aria-busy");
  arrange();
});
files.addEventListener("submit", (event) => event.preventDefault());

const removed = new Set();
let poll = new AbortController();

document.addEventListener("click", async (event) => {
  const button = event.target.closest("[data-do]");
  if (!button) return;
  const card = button.closest(".card"), key = card.dataset.key;
  const place = `${button.dataset.do === "remove-file" ? "files" : "models"}/${key}`;
  try {
    if (button.dataset.do === "stop" || button.dataset.do === "resume") {
      put(models, await send(`models/${key}/${button.dataset.do}`, {})).querySelector("button")?.focus();
      soon();
    } else {
      // No request for an element may follow its removal.
      removed.add(place);
      poll.abort();
      await request(place, { method: "DELETE" });
      card.remove();
      say("Removed.");
      (files.querySelector("button") || $("pick")).focus();
    }
  } catch (error) {
    removed.delete(place);
    say(error.message, true);
  }
  arrange();
  compare();
});

// ------------------------------------------------------------------------------------------------------------ structure

const facts = () => [...files.querySelectorAll(".file")].map((card) => ({
  key: card.dataset.key, ...JSON.parse(card.dataset.facts),
}));

function option(select, value, words) {
  const made = document.createElement("option");
  made.value = value;
  made.textContent = words;
  select.append(made);
}

function refill(select, entries) {
  const was = select.value;
  select.replaceChildren();
  entries.forEach(([value, words]) => option(select, value, words));
  if (entries.some(([value]) => value === was)) select.value = was;
}

// Update the form for the files that are available.
function arrange() {
  const runs = facts().filter((file) => file.run);
  $("ask-section").hidden = !runs.length;
  $("models-section").hidden = !models.children.length;
  refill($("estimation"), runs.map((run) => [run.key, run.name]));
  const others = runs.filter((run) => run.key !== $("estimation").value);
  refill($("validation"), [
    ["0.3", "the last 30 % of it"], ["0.2", "the last 20 % of it"], ["0.5", "the last half of it"],
    ...others.map((run) => [run.key, run.name]), ["0", "nothing: no model is trusted then"],
  ]);
  const run = runs.find((each) => each.key === $("estimation").value);
  if (run) offer(run);
  showMode();
}

function offer(run) {
  const place = $("offers"), written = JSON.stringify(run.offers);
  $("auto-mode").hidden = run.outputs.length !== 1;
  if (place.dataset.offers === written) return;
  place.dataset.offers = written;
  place.replaceChildren();
  const groups = {};
  for (const each of run.offers) {
    if (run.outputs.length > 1 && !groups[each.output]) {
      const group = groups[each.output] = document.createElement("div"), head = document.createElement("h3");
      group.setAttribute("role", "group");
      group.setAttribute("aria-label", `Structures of ${each.output}`);
      head.textContent = each.output;
      group.append(head);
      place.append(group);
    }
    const button = document.createElement("button"), name = document.createElement("strong");
    const why = document.createElement("span"), code = document.createElement("code");
    button.type = "button";
    name.textContent = each.name;
    why.textContent = each.why;
    code.textContent = each.structure;
    button.append(name, why, code);
    button.addEventListener("click", () => { $("structure").value = each.structure; mark(); check(); });
    (groups[each.output] || place).append(button);
  }
  if (run.offers.length && !run.offers.some((each) => each.structure === $("structure").value)) {
    $("structure").value = run.offers[Math.min(2, run.offers.length - 1)].structure;
  }
  mark();
}

function mark() {
  $("offers").querySelectorAll("button").forEach((button) => {
    button.setAttribute("aria-pressed", String(button.querySelector("code").textContent === $("structure").value));
  });
}

const WORDS = {
  fit: "The parameters of this equation are estimated.",
  inside: "Terms and free orders of this equation are added one by one, as long as what was not fitted to is predicted better. It takes several times as long.",
  offered: "Each structure below without dry friction is fitted to three quarters of the run and judged on the fourth, in turn.",
  auto: "Whole orders 1 to 4, every input, then free orders: what predicts best what it was not fitted to. It takes minutes.",
};

function showMode() {
  const chosen = ask.elements.selection_mode.value;
  if (chosen === "auto" && $("auto-mode").hidden) { ask.elements.selection_mode.value = "fit"; return showMode(); }
  $("mode-text").textContent = WORDS[chosen];
  $("equation-field").hidden = chosen === "offered" || chosen === "auto";
  $("offers").hidden = chosen === "auto";
  $("offers").classList.toggle("all", chosen === "offered");
}

function wanted() {
  const run = facts().find((each) => each.key === $("estimation").value), on = $("validation").value;
  const share = /^[0-9.]+$/.test(on) && on.length < 5, mode = ask.elements.selection_mode.value;
  const first = run ? run.offers.filter((each) => each.output === run.outputs[0] && !each.structure.includes("sign(")).map((each) => each.structure) : [];
  return {
    estimation: $("estimation").value, validation: share ? "" : on, share: share ? Number(on) : 0, selection_mode: mode,
    structure: mode === "auto" ? [] : mode === "offered" ? first : [$("structure").value],
    method: ask.elements.method.value, offset: ask.elements.offset.value, loss: ask.elements.loss.value,
  };
}

function wrong(words) {
  $("structure-error").textContent = words;
  if (words) $("structure").setAttribute("aria-invalid", "true"); else $("structure").removeAttribute("aria-invalid");
}

let pause = 0;
async function check() {
  try {
    wrong(JSON.parse(await send("check", wanted())).error);
  } catch (refused) {
    say(refused.message, true);
  }
}

$("structure").addEventListener("input", () => { mark(); clearTimeout(pause); pause = setTimeout(check, 500); });
ask.addEventListener("change", (event) => {
  if (event.target.id === "estimation") arrange();
  showMode();
  if (event.target.id !== "structure") wrong("");
});
ask.addEventListener("submit", async (event) => {
  event.preventDefault();
  clearTimeout(pause);
  try {
    const part = put(models, await send("models", wanted()), true);
    wrong("");
    arrange();
    say(`Model ${part.querySelector("h3").textContent} is on its way.`);
    part.scrollIntoView({ block: "nearest", behavior: "smooth" });
    soon();
  } catch (error) {
    if ($("equation-field").hidden) say(error.message, true);
    else wrong(error.message);
  }
});

// ------------------------------------------------------------------------------------------------------------ models

async function compare() {
  try {
    $("comparison").innerHTML = await request("comparison");
  } catch (error) {
    say(error.message, true);
  }
}

function progress(card, state) {
  const bar = card.querySelector("progress"), doing = card.querySelector(".doing");
  if (!bar || !doing) return;
  if (state.share === null) bar.removeAttribute("value"); else bar.value = state.share;
  const share = state.share === null ? "" : ` · ${Math.floor(100 * state.share)} %`;
  doing.textContent = `${state.phase}${share}${state.left ? ` · ${state.left}` : ""}`;
}

async function look() {
  poll = new AbortController();
  const { signal } = poll;
  const state = JSON.parse(await request("state", { signal }));
  let changed = false;
  for (const [key, each] of Object.entries(state.models)) {
    if (removed.has(`models/${key}`)) continue;
    const card = document.getElementById(`model-${key}`);
    if (!card || Number(card.dataset.version) !== each.version) {
      const part = put(models, await request(`models/${key}`, { signal }), true);
      changed = true;
      if (!each.busy && card && part.dataset.state !== card.dataset.state) {
        say(`Model ${part.querySelector("h3").textContent}: ${part.querySelector(".first strong, .box strong")?.textContent || part.dataset.state}`);
      }
    } else if (each.busy) progress(card, each);
  }
  for (const card of models.querySelectorAll(".model")) {
    if (!(card.dataset.key in state.models)) { card.remove(); changed = true; }
  }
  for (const [key, version] of Object.entries(state.files)) {
    if (removed.has(`files/${key}`)) continue;
    const card = document.getElementById(`file-${key}`);
    if (version && (!card || Number(card.dataset.version) < version) && !files.querySelector("[aria-busy]")) {
      say(`“${put(files, await request(`files/${key}`, { signal })).querySelector("h3").textContent}” is read.`);
      changed = true;
    }
  }
  if (changed) { arrange(); await compare(); }
  return Object.values(state.models).some((each) => each.busy);
}

let timer = 0, lost = false;
async function again() {
  clearTimeout(timer);
  let busy = false;
  try {
    busy = await look();
    if (lost) { lost = false; say("ftlm app answers again."); }
  } catch (error) {
    if (!lost && !poll.signal.aborted) { lost = true; say(error.message, true); }
  }
  timer = setTimeout(again, busy ? 300 : lost ? 3000 : 2000);
}
const soon = () => { clearTimeout(timer); timer = setTimeout(again, 50); };

arrange();
again();
