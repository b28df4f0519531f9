// The operator's page: what is going on, what is asked, and how to stop.

import { Refused, call, knownToken, listen, reach, saveReport, useToken } from "./talk.js";
import {
  button, cellLine, chartFigure, clock, draw, el, endedList, fillRack, previousRuns, modeBadge, nightTimeline, poursTable, questionCard, queueList, rackFigure, rigCard,
  stopCard, vesselsTable,
} from "./show.js";

const $ = (id) => document.getElementById(id);
const RUNNING = ["preparing", "running", "pausing", "waiting for operator", "stopping"];
const WAITING = ["queued", "checking"];
const BEAT = 2000, SILENCE = 6000;
/* How often the daemon is called [ms], and after which silence the page no longer relies on it. */
const PHYSICAL = "press the physical emergency stop: the red mushroom button on the teach pendant";
const now = { status: null, campaigns: [], questions: [], pours: [], racks: [], night: [], vessels: [], seen: 0, heard: 0, up: null, clearing: null };
let wanted = 0, busy = false, begun = false, joined = false;

// ---- what is known

async function refresh() {
  if (away()) return;
  if (busy) { wanted = 1; return; }
  busy = true;
  try {
    const [status, campaigns, questions] = await Promise.all([call("status"), call("campaigns?limit=60"), call("questions")]);
    if (away()) return;
    Object.assign(now, { status, campaigns, questions, seen: Date.now() });
    const running = campaigns.filter((one) => RUNNING.includes(one.state) && one.run);
    const shown = running.length ? running : campaigns.filter((one) => one.run).slice(0, 1);
    const details = await Promise.all(shown.map((one) => call(`campaigns/${encodeURIComponent(one.id)}`)));
    const stored = await call("materials").catch(() => ({ sources: now.vessels })); // of less weight than the rest
    if (away()) return;
    now.vessels = stored.sources.filter((one) => one.position);
    now.racks = details.filter((one) => one.rack).map(({ name, rack, mixtures }) => ({ name, rack, mixtures }));
    now.night = details.flatMap((one) => one.night).sort((one, other) => one.time - other.time);
    now.pours = details.flatMap((one) => one.pours_made.map((pour) => ({ ...pour, campaign: one.name })))
      .filter((pour) => pour.state !== "asked").sort((one, other) => other.time - one.time).slice(0, 8);
    show();
    link(true);
    refreshCharts();
  } catch (error) {
    if (error.status === 401) leave(error.message);
    else if (error instanceof Refused) $("told").textContent = `No news: ${error.message}`; // it answers, so a stop may work
    else beat();
  } finally {
    busy = false;
    if (wanted) { wanted = 0; soon(300); }
  }
}

/** Whether nobody is signed in: what was known then is not shown. */
const away = () => !$("login").hidden;

let charted = 0;

/** The control charts that have limits, every ten minutes: they change by the day. */
async function refreshCharts() {
  if (Date.now() - charted < 600000) return;
  charted = Date.now();
  const charts = await call("runs/charts", undefined, { timeout: 60000 }).catch(() => null);
  if (!charts || away()) return;
  const shown = charts.filter((chart) => chart.points.some((point) => point.deviations !== null));
  $("charts").hidden = !shown.length;
  draw(body("charts"), shown, (all) => all.map(chartFigure));
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
  if (away()) return;
  if (type === "QuestionAsked") announce("call", `A question: ${data.question.text}`);
  if (type === "Announced") announce("call", `In ${Math.round(data.seconds)} seconds: ${data.text}`);
  if (type === "CampaignRests") announce("say", `${data.campaign}: ${data.verdict?.text ?? data.state}`);
  if (type === "LogLine" && data.level === "error") alarm(data.text);
  if (type === "ChartViolated") { announce("say", data.text); charted = 0; }
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

let beating = null;

/** Call the daemon now; what the page shows of the connection follows from the answer. */
function beat() {
  beating ??= reach().then(() => link(true), () => link(false)).finally(() => { beating = null; });
  return beating;
}

async function beats() {
  for (;;) {
    if (!away()) await beat();
    await new Promise((go) => setTimeout(go, BEAT));
  }
}

/** A tab that slept, or a clock that went on without an answer: not connected until the daemon answers again. */
function doubt() {
  if (now.up && Date.now() - now.heard > SILENCE) link(false);
  beat();
}

function link(up) {
  if (away()) return;
  if (up) now.heard = Date.now();
  const changed = up !== now.up;
  now.up = up;
  const person = now.status?.person;
  $("link").replaceChildren(...(up ? [`connected, ${clock(now.heard / 1000)}`, el("span", { class: "words" }, person ? `, ${person.name} (${person.role})` : "")] : ["NO CONNECTION"]));
  if (!changed) return;
  $("lost").hidden = up;
  $("lost").replaceChildren(...(up ? [] : [
    el("b", { class: "loud" }, "No connection to the daemon: the stop in this page does NOT work now."),
    el("span", {}, ` To stop the arm, ${PHYSICAL}.${now.seen ? ` What you see is from ${clock(now.seen / 1000)}.` : ""}`),
  ]));
  document.body.classList.toggle("stale", !up);
  if (!up) now.clearing = null;
  if (now.status) { showStops(); showEmergencies(); }
  else $("stop-all").disabled = !up;
  if (up) soon(0);
}

// ---- what is shown

function show() {
  const { status, campaigns } = now;
  const real = status.rigs.filter((rig) => rig.mode === "hardware");
  draw($("mode"), real.map((rig) => rig.name), (names) => names.length ?
    [modeBadge("hardware"), el("span", { class: "words" }, ` ${names.join(", ")}: a real arm`)] : [modeBadge("virtual"), el("span", { class: "words" }, " nothing real moves")]);
  document.body.classList.toggle("real", real.length > 0);
  showStops();
  showEmergencies();
  showQuestions();
  const byId = Object.fromEntries(campaigns.map((one) => [one.id, one]));
  const rigs = status.rigs.filter((rig) => rig.mode !== "none" || rig.campaign).map((rig) => [rig, byId[rig.campaign] || null]);
  draw(body("rigs"), [rigs, status.problems, status.ready, stops(), now.up], () => [
    status.problems.map((problem) => el("p", { class: "problem" }, problem)),
    status.ready || status.problems.length || stops().length ? null : el("p", { class: "quiet" }, "The simulators are starting."),
    rigs.map(([rig, campaign]) => rigCard(rig, campaign, { stopped: Boolean(status.emergency || rig.emergency), several: status.rigs.filter((one) => one.mode !== "none").length > 1, up: now.up }, allowed())),
  ]);
  $("racks").hidden = !now.racks.length;
  draw(body("racks"), now.racks.map(({ name }) => name), () => now.racks.map(rackFigure));
  now.racks.forEach((rack, index) => fillRack(body("racks").children[index], rack));
  draw(body("pours"), now.pours, poursTable);
  $("night").hidden = !now.night.length;
  draw(body("night"), now.night, (events) => events.length ? nightTimeline(events) : []);
  $("vessels").hidden = !now.vessels.length;
  draw(body("vessels"), now.vessels, vesselsTable);
  const queued = campaigns.filter((one) => WAITING.includes(one.state));
  draw(body("queue"), [queued, status.queue_paused], ([items, paused]) => queueList(items, paused, allowed()));
  const ended = campaigns.filter((one) => !WAITING.includes(one.state) && !RUNNING.includes(one.state)).slice(0, 8);
  draw(body("ended"), ended, (items) => endedList(items, allowed()));
  const open = now.questions.length;
  document.title = stops().length ? "STOPPED – Decant" : open ? `(${open}) question – Decant` : "Decant";
}

const body = (id) => $(id).querySelector(".body");

/** Emergency stops that are latched: the one of all rigs, and those of single ones. */
function stops() {
  const { emergency, rigs } = now.status;
  return [...(emergency ? [{ rig: "", ...emergency }] : []),
    ...rigs.filter((rig) => rig.emergency).map((rig) => ({ rig: rig.name, ...rig.emergency }))];
}

let latched = "";

function showEmergencies() {
  const found = stops(), was = latched;
  latched = JSON.stringify(found);
  if (latched !== was) { // another stop than the one that was asked about
    now.clearing = null;
    if (found.length) announce("call", found.map((stop) => stop.rig ? `Emergency stop of ${stop.rig}` : "Emergency stop").join(". "));
  }
  const queued = now.campaigns.filter((one) => one.state === "queued");
  const waiting = (stop) => queued.filter((one) => !stop.rig || one.rig === stop.rig).length;
  draw($("emergency"), [found, now.clearing, found.map(waiting)], ([all, asking]) =>
    all.map((stop) => stopCard(stop, asking === stop.rig, waiting(stop), allowed())));
}

function showQuestions() {
  const section = $("questions"), known = new Map([...section.children].map((card) => [card.dataset.question, card]));
  const modes = Object.fromEntries(now.status.rigs.map((rig) => [rig.name, rig.mode]));
  for (const question of now.questions) {
    const key = String(question.id);
    if (known.delete(key)) continue; // what somebody is typing stays
    const campaign = now.campaigns.find((one) => one.id === question.campaign)?.name || question.campaign;
    const card = questionCard(question, campaign, modes[question.rig] || "virtual", allowed().answer);
    section.append(card);
    const free = document.activeElement === document.body || document.activeElement === $("main");
    if (free) card.querySelector("h2").focus({ preventScroll: true });
    if (navigator.userActivation?.hasBeenActive) navigator.vibrate?.(200);
  }
  for (const card of known.values()) {
    const stood = card.contains(document.activeElement);
    card.remove();
    if (stood) (section.querySelector("h2") || $("main")).focus({ preventScroll: true });
  }
  draw($("asked"), now.questions.length, (open) => open ?
    [button("asked", open > 1 ? `${open} questions` : "1 question", async () => section.querySelector("h2")?.focus(), "plain")] : []);
}

/** The header's part that must work: the state of each rig, and the stops, which work only while the daemon answers. */
function showStops() {
  const { status, campaigns, up } = now;
  const byId = Object.fromEntries(campaigns.map((one) => [one.id, one]));
  const rigs = status.rigs.filter((rig) => rig.mode !== "none"), several = rigs.length > 1;
  const mixed = new Set(rigs.map((rig) => rig.mode)).size > 1;
  const lines = rigs.map((rig) => [rig, byId[rig.campaign] || null, {
    stopped: Boolean(status.emergency || rig.emergency), several, mixed, up,
  }]);
  draw($("cells"), lines, (all) => all.map(([rig, campaign, how]) => cellLine(rig, campaign, how, acts)));
  $("bar").classList.toggle("several", several);
  $("stop-all").textContent = several ? "EMERGENCY STOP ALL" : "EMERGENCY STOP";
  $("stop-all").disabled = !up;
}

// ---- what people do

async function doing(what, work) {
  $("told").textContent = `${what} …`;
  try {
    await work();
    $("told").textContent = `${what}: done`;
    return true;
  } catch (error) {
    $("told").textContent = `${what}: ${error instanceof Refused ? error.message : "the daemon can't be reached"}`;
    if (!(error instanceof Refused)) link(false);
    return false;
  } finally {
    soon(0);
  }
}

/** An emergency stop, of one rig or ('') of all. One that is not confirmed is not missed. */
async function stop(rig) {
  const what = rig ? `STOP ${rig}` : "EMERGENCY STOP";
  const done = await doing(what, () => call(`emergency-stop?rig=${encodeURIComponent(rig)}&reason=from+the+page`, undefined, { method: "POST", timeout: 8000 }));
  if (!done) alarm(`${what} was not confirmed: ${PHYSICAL}.`);
}

const ROLES = ["viewer", "operator", "admin"];
const NEEDS = { answer: "operator", end: "operator", resume: "operator", earlier: "operator", hold: "operator", note: "operator", askClear: "admin", clear: "admin" };

/** What the person who is signed in may do: buttons for the rest are not shown. */
function allowed() {
  const role = ROLES.indexOf(now.status?.person.role);
  return Object.fromEntries(Object.entries(acts).filter(([name]) => role >= ROLES.indexOf(NEEDS[name] || "viewer")));
}

const of = (item, command) => call(`campaigns/${encodeURIComponent(item.id)}/${command}`, undefined, { method: "POST" });
const acts = {
  answer: async (question, text) => { await call(`questions/${question.id}/answer`, { answer: text }); soon(0); },
  end: (item, command) => doing(`${command} ${item.name}`, () => of(item, command)),
  resume: (item) => doing(`go on with ${item.name}`, () => of(item, "resume")),
  earlier: (item, other) => doing("move", () => call(`campaigns/${encodeURIComponent(item.id)}/move`, { before: other.id })),
  hold: (hold) => doing(hold ? "hold the queue" : "let the queue go on",
    () => call(`queue/${hold ? "pause" : "resume"}`, undefined, { method: "POST" })),
  report: (id) => doing("report", () => saveReport(id)),
  previousReport: (run) => doing(`report of ${run.run}`, () => saveReport(run.run, "runs")),
  note: async (run) => {
    const text = prompt(`What is to be remembered of ${run.run}?`)?.trim();
    if (!text) return;
    await doing(`note on ${run.run}`, () => call(`runs/${encodeURIComponent(run.run)}/notes`, { text }));
    await find();
  },
  stopRig: (rig) => stop(rig),
  askClear: (rig) => { // 'No' has the focus: Enter and Escape keep the stop
    const was = now.clearing;
    now.clearing = now.up ? rig : null;
    showEmergencies();
    const next = now.clearing === null ? `ask ${was}` : `keep ${rig}`;
    $("emergency").querySelector(`[data-key="${CSS.escape(next)}"]`)?.focus({ preventScroll: true });
  },
  clear: (rig) => doing(rig ? `clear the stop of ${rig}` : "clear the emergency stop", () => call("emergency-stop/clear", { rig })),
};

/** Previous runs that have all the words. */
async function find() {
  const query = new URLSearchParams([["limit", 8], ...$("words").value.split(/\s+/).filter(Boolean).map((word) => ["words", word])]);
  await doing("look for runs", async () => {
    const runs = await call(`runs?${query}`, undefined, { timeout: 60000 });
    draw(body("previous"), runs, (found) => previousRuns(found, allowed()));
    body("previous").hidden = false;
  });
}

// ---- coming and going

async function enter() {
  try { await call("status"); } catch (error) {
    if (error.status === 401 || error.status === 429) { leave(error.message); return; }
  }
  $("login").hidden = true;
  $("rest").hidden = false;
  showBar(true);
  await refresh();
  if (!begun) {
    begun = true;
    setInterval(() => { if (!$("rest").hidden) refresh(); }, 5000);
    beats();
  }
  if (!joined) { // one listener, whoever comes and goes in this tab
    joined = true;
    listen(told, (stands, error) => { if (error) { joined = false; leave(error.message); } else if (stands) soon(0); else beat(); });
  }
}

/** The bar with the stop, or what to do without it. */
function showBar(shown) {
  $("bar").hidden = !shown;
  $("no-stop").hidden = shown;
}

function leave(why = "") {
  useToken("");
  $("refused").textContent = why;
  $("login").hidden = false;
  $("rest").hidden = true;
  showBar(false);
  $("questions").replaceChildren();
  for (const section of [...["mode", "asked", "cells", "emergency"].map($), ...["rigs", "racks", "pours", "night", "charts", "queue", "ended"].map(body)]) {
    draw(section, null, () => []);
  }
  $("lost").hidden = true;
  $("told").textContent = "";
  $("stop-all").disabled = true;
  document.title = "Decant";
  document.body.classList.remove("real", "stale");
  Object.assign(now, { status: null, campaigns: [], questions: [], pours: [], racks: [], night: [], vessels: [], up: null, clearing: null });
  latched = "";
  charted = 0;
  $("link").textContent = "not signed in";
  $("token").focus({ preventScroll: true });
}

$("login").addEventListener("submit", (event) => {
  event.preventDefault();
  useToken($("token").value.trim());
  $("token").value = "";
  enter();
});
$("search").addEventListener("submit", (event) => { event.preventDefault(); find(); });
$("stop-all").addEventListener("click", () => stop(""));
addEventListener("offline", doubt);
document.addEventListener("visibilitychange", () => { if (!document.hidden) doubt(); });
new ResizeObserver(() => { // what gets the focus is not covered by the header
  document.documentElement.style.scrollPaddingTop = `${$("head").offsetHeight + 8}px`;
}).observe($("head"));

$("zone").textContent = `Times are in the zone of this browser: ${Intl.DateTimeFormat().resolvedOptions().timeZone}.`;

function come() { if (knownToken()) enter(); else leave(); }
addEventListener("hashchange", () => { // another person may do other things: everything is drawn anew
  if (location.hash.includes("token=") && knownToken()) location.reload();
});
come();
