// The operator's page: what is going on, what is asked, and how to stop.

import { Refused, call, knownToken, listen, saveReport, useToken } from "./talk.js";
import { button, clock, draw, el, endedList, formerRuns, modeBadge, poursTable, questionCard, queueList, rigCard } from "./show.js";

const $ = (id) => document.getElementById(id);
const RUNNING = ["preparing", "running", "pausing", "waiting for operator", "stopping"];
const now = { status: null, campaigns: [], questions: [], pours: [], seen: 0 };
let wanted = 0, busy = false, joined = false;

// ---- what is known

async function refresh() {
  if (busy) { wanted = 1; return; }
  busy = true;
  try {
    const [status, campaigns, questions] = await Promise.all([call("status"), call("campaigns?limit=60"), call("questions")]);
    Object.assign(now, { status, campaigns, questions, seen: Date.now() });
    const shown = campaigns.find((one) => RUNNING.includes(one.state) && one.run) || campaigns.find((one) => one.run);
    const detail = shown ? await call(`campaigns/${encodeURIComponent(shown.id)}`) : null;
    const open = shown && !RUNNING.includes(shown.state) ? "UNKNOWN" : "under way";
    now.pours = (detail ? detail.pours_made : []).filter((pour) => pour.state !== "asked").slice(-8).reverse()
      .map((pour) => ({ ...pour, state: pour.state === "under way" ? open : pour.state }));
    show();
    link(true);
  } catch (error) {
    if (error.status === 401) leave(error.message);
    else link(false, error instanceof Refused ? error.message : "");
  } finally {
    busy = false;
    if (wanted) { wanted = 0; soon(300); }
  }
}

let timer = 0, due = Infinity;

/** Look again after so long [ms], or earlier where that is planned: news that never pause postpone nothing. */
function soon(delay) {
  if (performance.now() + delay >= due) return;
  clearTimeout(timer);
  due = performance.now() + delay;
  timer = setTimeout(() => { due = Infinity; refresh(); }, delay);
}

function told(type, data) {
  if (type === "QuestionAsked") announce("call", `A question: ${data.question.text}`);
  if (type === "Announced") announce("call", `In ${Math.round(data.seconds)} seconds: ${data.text}`);
  if (type === "CampaignRests") announce("say", `${data.campaign}: ${data.state}`);
  if (type === "LogLine" && data.level === "error") alarm(data.text);
  if (type === "PourProgressed") { soon(700); return; }
  soon(150);
}

function announce(where, text) {
  $(where).textContent = "";
  setTimeout(() => { $(where).textContent = text; }, 50); // a change is read out, what stood there is not
}

/** What must not be missed stands until somebody takes it away: an arm that did not confirm a stop, say. */
function alarm(text) {
  const line = el("p", {}, `${clock(Date.now() / 1000)} ${text} `, button(`read ${text}`, "Read", async () => line.remove(), "plain"));
  $("alarms").append(line);
  while ($("alarms").children.length > 5) $("alarms").firstChild.remove();
}

function link(stands, why = "") {
  $("link").textContent = stands ? `up to date, ${clock(Date.now() / 1000)}` : "no connection";
  $("lost").hidden = stands;
  document.body.classList.toggle("stale", !stands);
  if (!stands) {
    const since = now.seen ? `What you see is of ${clock(now.seen / 1000)}. ` : "";
    $("lost").textContent = `No connection to the daemon${why ? ` (${why})` : ""}. ${since}To stop the arm, use its own emergency stop.`;
  }
}

// ---- what is shown

function show() {
  const { status, campaigns } = now;
  const real = status.rigs.filter((rig) => rig.mode === "hardware");
  draw($("mode"), real.map((rig) => rig.name), (names) => names.length ?
    [modeBadge("hardware"), ` ${names.join(", ")}: a real arm`] : [modeBadge("virtual"), " nothing real moves"]);
  document.body.classList.toggle("real", real.length > 0);
  showEmergency(status.emergency);
  showQuestions();
  const byId = Object.fromEntries(campaigns.map((one) => [one.id, one]));
  const rigs = status.rigs.filter((rig) => rig.mode !== "none" || rig.campaign).map((rig) => [rig, byId[rig.campaign] || null]);
  draw(body("rigs"), [rigs, status.problems, status.ready], () => [
    status.problems.map((problem) => el("p", { class: "problem" }, problem)),
    status.ready || status.problems.length || status.emergency ? null : el("p", { class: "quiet" }, "The simulators are starting."),
    rigs.map(([rig, campaign]) => rigCard(rig, campaign, acts)),
  ]);
  draw(body("pours"), now.pours, poursTable);
  const queued = campaigns.filter((one) => one.state === "queued");
  draw(body("queue"), [queued, status.queue_paused], ([items, paused]) => queueList(items, paused, acts));
  const ended = campaigns.filter((one) => one.state !== "queued" && !RUNNING.includes(one.state)).slice(0, 8);
  draw(body("ended"), ended, (items) => endedList(items, acts));
  showStops(campaigns.filter((one) => RUNNING.includes(one.state)));
  const open = now.questions.length;
  document.title = status.emergency ? "STOPPED – Decant" : open ? `(${open}) question – Decant` : "Decant";
}

const body = (id) => $(id).querySelector(".body");

function showEmergency(emergency) {
  if (emergency && $("emergency").hidden) announce("call", "Emergency stop");
  $("emergency").hidden = !emergency;
  draw($("emergency"), emergency, (latched) => latched && [
    el("h2", { id: "emergency-head" }, "Emergency stop"),
    el("p", {}, `By ${latched.by} at ${clock(latched.time)}${latched.reason ? `: ${latched.reason}` : ""}. All arms were told to stop, `,
      "and nothing begins before it is cleared. A pour that was under way is UNKNOWN: somebody will be asked about it."),
    el("details", {}, el("summary", {}, "Clear it"),
      el("p", {}, "Is nobody in the cell, and does nothing stand or hang where it should not?"),
      button("clear", "Yes: take work again", () => acts.clear(), "plain danger")),
  ]);
}

function showQuestions() {
  const section = $("questions"), known = new Map([...section.children].map((card) => [card.dataset.question, card]));
  const modes = Object.fromEntries(now.status.rigs.map((rig) => [rig.name, rig.mode]));
  for (const question of now.questions) {
    const key = String(question.id);
    if (known.delete(key)) continue; // what somebody is typing stays
    const campaign = now.campaigns.find((one) => one.id === question.campaign)?.name || question.campaign;
    const card = questionCard(question, campaign, modes[question.rig] || "virtual", acts.answer);
    section.append(card);
    const free = document.activeElement === document.body || document.activeElement === $("main");
    if (free) card.querySelector("h2").focus({ preventScroll: false });
    if (navigator.userActivation?.hasBeenActive) navigator.vibrate?.(200);
  }
  for (const card of known.values()) {
    const stood = card.contains(document.activeElement);
    card.remove();
    if (stood) (section.querySelector("h2") || $("main")).focus();
  }
}

function showStops(running) {
  $("bar").hidden = false;
  const of = running.length > 1 ? ` all ${running.length}` : "";
  draw($("grades"), running.map((one) => one.id), () => running.length ? [
    button("pause", `Pause${of}`, () => acts.endAll(running, "pause"), "grade"),
    button("stop", `Finish and end${of}`, () => acts.endAll(running, "stop"), "grade"),
    button("abort", `Stop the motion${of}`, () => acts.endAll(running, "abort"), "grade danger"),
  ] : [el("p", { class: "quiet" }, "Nothing runs.")]);
  $("stop-all").disabled = Boolean(now.status.emergency);
}

// ---- what people do

async function doing(what, work) {
  $("told").textContent = `${what} …`;
  try {
    await work();
    $("told").textContent = `${what}: done`;
  } catch (error) {
    $("told").textContent = `${what}: ${error instanceof Refused ? error.message : "the daemon can't be reached"}`;
    if (!(error instanceof Refused)) link(false);
  }
  soon(0);
}

const of = (item, verb) => call(`campaigns/${encodeURIComponent(item.id)}/${verb}`, undefined, { method: "POST" });
const acts = {
  answer: async (question, text) => { await call(`questions/${question.id}/answer`, { answer: text }); soon(0); },
  end: (item, verb) => doing(`${verb} ${item.name}`, () => of(item, verb)),
  endAll: (items, verb) => doing(verb, () => Promise.all(items.map((item) => of(item, verb)))),
  resume: (item) => doing(`go on with ${item.name}`, () => of(item, "resume")),
  earlier: (item, other) => doing("move", () => call(`campaigns/${encodeURIComponent(item.id)}/move`, { before: other.id })),
  hold: (hold) => doing(hold ? "hold the queue" : "let the queue go on",
    () => call(`queue/${hold ? "pause" : "resume"}`, undefined, { method: "POST" })),
  report: (id) => doing("report", () => saveReport(id)),
  formerReport: (run) => doing(`report of ${run.run}`, () => saveReport(run.run, "runs")),
  note: async (run) => {
    const text = prompt(`What is to be remembered of ${run.run}?`)?.trim();
    if (!text) return;
    await doing(`note on ${run.run}`, () => call(`runs/${encodeURIComponent(run.run)}/notes`, { text }));
    await find();
  },
  stopAll: () => doing("EMERGENCY STOP", () => call("emergency-stop", { reason: "from the page" })),
  clear: () => doing("clear the emergency stop", () => call("emergency-stop/clear", undefined, { method: "POST" })),
};

/** Former runs that have all the words. */
async function find() {
  const query = new URLSearchParams([["limit", 8], ...$("words").value.split(/\s+/).filter(Boolean).map((word) => ["words", word])]);
  await doing("look for runs", async () => {
    const runs = await call(`runs?${query}`, undefined, { timeout: 60000 });
    draw(body("former"), runs, (found) => formerRuns(found, acts));
    body("former").hidden = false;
  });
}

// ---- coming and going

async function enter() {
  try { await call("status"); } catch (error) {
    if (error.status === 401 || error.status === 429) { leave(error.message); return; }
  }
  $("login").hidden = true;
  $("rest").hidden = false;
  await refresh();
  if (!joined) { // one listener, whoever comes and goes in this tab
    joined = true;
    setInterval(() => { if (!$("rest").hidden) refresh(); }, 5000);
    listen(told, (stands, error) => { if (error) { joined = false; leave(error.message); } else if (stands) soon(0); else link(false); });
  }
}

function leave(why = "") {
  useToken("");
  $("refused").textContent = why;
  $("login").hidden = false;
  $("rest").hidden = true;
  $("bar").hidden = true;
  $("questions").replaceChildren();
  $("mode").textContent = "";
  $("link").textContent = "not signed in";
  $("token").focus();
}

$("login").addEventListener("submit", (event) => {
  event.preventDefault();
  useToken($("token").value.trim());
  $("token").value = "";
  enter();
});
$("search").addEventListener("submit", (event) => { event.preventDefault(); find(); });
$("stop-all").addEventListener("click", acts.stopAll);

function come() { if (knownToken()) enter(); else leave(); }
addEventListener("hashchange", () => { if (location.hash.includes("token=")) come(); });
come();
