// What is on the page. Everything that comes from the daemon is set as text, never as HTML.

const MODES = { hardware: "REAL", virtual: "VIRTUAL", none: "no bench" };
const STATES = { "waiting for operator": "waits for an answer", unknown: "UNKNOWN pour" };

/** An element: name, its attributes (on… are listeners), children. */
export function el(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else made.setAttribute(key, value === true ? "" : value);
  }
  made.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== ""));
  return made;
}

/** A button that can't be pressed twice at once, and keeps the focus when its neighbourhood is drawn anew. */
export function button(key, text, act, look = "") {
  return el("button", {
    type: "button", class: look, "data-key": key,
    onclick: async (event) => {
      const pressed = event.currentTarget;
      if (pressed.getAttribute("aria-busy")) return;
      pressed.setAttribute("aria-busy", "true");
      try { await act(); } finally { pressed.removeAttribute("aria-busy"); }
    },
  }, text);
}

/** Draw a section anew where its data have changed; whoever stood on a button in it stands there still. */
export function draw(section, data, build) {
  const now = JSON.stringify(data);
  if (section.was === now) return;
  section.was = now;
  const key = section.contains(document.activeElement) ? document.activeElement.dataset.key : null;
  section.replaceChildren(...[build(data)].flat(Infinity).filter(Boolean));
  if (key) section.querySelector(`[data-key="${CSS.escape(key)}"]`)?.focus({ preventScroll: true });
}

export const modeBadge = (mode) => el("strong", { class: `badge ${mode}` }, MODES[mode] || mode);
export const stateText = (state) => STATES[state] || state;
export const percent = (share) => `${(100 * share).toFixed(2)} %`;
export const clock = (seconds) => new Date(1000 * seconds).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit" });

export function lasting(seconds) {
  if (seconds < 90) return `${Math.round(seconds)} s`;
  return seconds < 5400 ? `${Math.round(seconds / 60)} min` : `${(seconds / 3600).toFixed(1)} h`;
}

const MOVING = ["approach", "tilt", "hold", "return"];

/** One rig in the header: its state and, if there are several, a stop of its own, and its mode if they differ. */
export function cellLine(rig, campaign, { stopped, several, mixed, up }, acts) {
  const blocked = rig.arm?.state === "fail" ? "arm can't move" : "idle";
  const state = stopped ? el("strong", { class: "badge stopped" }, "STOPPED") : !campaign ? blocked :
    MOVING.includes(rig.checkpoint) ? "arm moves" : stateText(campaign.state);
  return el("li", { class: rig.mode },
    el("span", {}, el("b", {}, rig.name), mixed ? [" ", modeBadge(rig.mode)] : "", up ? ": " : " (last known): ", state),
    several ? stopButton(rig, up, acts) : null);
}

const stopButton = (rig, up, acts, look = "") => el("button", { type: "button", class: `emergency one ${look}`,
  "data-key": `stop ${look} ${rig.name}`, disabled: !up, onclick: () => acts.stopRig(rig.name) }, `STOP ${rig.name}`);

/** A latched emergency stop. Clearing it is one question, whose answer "No" has the focus. */
export function stopCard(stop, asking, waiting, acts) {
  const all = !stop.rig, name = all ? "Emergency stop" : `Emergency stop of ${stop.rig}`, head = `stop-head-${stop.rig}`;
  return el("section", { class: "latched", "aria-labelledby": head,
    onkeydown: (event) => { if (asking && event.key === "Escape") acts.askClear(null); } },
  el("h2", { id: head }, name),
  el("p", {}, `By ${stop.by} at ${clock(stop.time)}${stop.reason ? `: ${stop.reason}` : ""}. `,
    all ? "The program has sent a stop request to all arms, and starts nothing before this stop is cleared. " :
      "The program has sent a stop request to its arm, and starts nothing on this rig before this stop is cleared. ",
    "A pour that was under way is UNKNOWN: the operator is asked about it."),
  asking ? [
    el("h3", {}, all ? "Are all cells clear of people and obstacles?" : `Is the cell of ${stop.rig} clear of people and obstacles?`),
    el("p", {}, waiting ? `Yes ends the emergency stop. Queued campaigns that it may start: ${waiting}.` : "Yes ends the emergency stop."),
    el("div", { class: "answers" },
      button(`keep ${stop.rig}`, "No, stay stopped", async () => acts.askClear(null), "big go"),
      button(`clear ${stop.rig}`, "Yes, clear the stop", () => acts.clear(stop.rig), "plain danger")),
  ] : !acts.askClear ? el("p", {}, "An administrator clears it.") : button(`ask ${stop.rig}`, all ? "Clear the stop" : `Clear the stop of ${stop.rig}`, async () => acts.askClear(stop.rig), "plain danger"));
}

const sentence = (text) => /[.?!]$/.test(text) ? text : `${text}.`;

/** Whether an idle arm can move, and what to do if it can't. */
function armStatus(arm) {
  if (!arm) return null;
  if (arm.state === "ok") return el("p", { class: "arm" }, `Arm: ${sentence(arm.text)}`);
  return el("p", { class: "arm problem" }, el("b", {}, arm.state === "fail" ? "The arm can't move" : "Arm", ` (since ${clock(arm.time)}): ${sentence(arm.text)}`),
    arm.advice ? ` ${sentence(arm.advice[0].toUpperCase() + arm.advice.slice(1))}` : "");
}

/** One rig: its campaign, and how to pause or end it. On narrow screens, which have no room for them in the header, also its stop. */
export function rigCard(rig, campaign, { stopped, several, up }, acts) {
  const idle = !campaign;
  const progress = campaign?.progress;
  return el("article", { class: `card ${rig.mode}`, "aria-label": `rig ${rig.name}` },
    el("h3", {}, rig.name, " ", modeBadge(rig.mode), stopped ? [" ", el("strong", { class: "badge stopped" }, "STOPPED")] : ""),
    several ? stopButton(rig, up, acts, "narrow") : null,
    armStatus(rig.arm),
    idle ? el("p", { class: "quiet" }, "Nothing runs here.") : [
      el("p", { class: "what" }, el("b", {}, campaign.name), ` ${stateText(campaign.state)}`,
        campaign.desired_state !== "run" ? ` (asked to ${campaign.desired_state})` : "", followers(campaign)),
      progress ? [
        el("p", {}, progress.stage ? `${progress.stage} (stage ${progress.stage_index} of ${progress.stage_count})` : "",
          progress.seconds_left ? `, about ${lasting(progress.seconds_left)} left` : ""),
        progress.pour ? el("p", { class: "pour" }, progress.pour) : null,
        progress.dose ? el("p", { class: "pour" }, progress.dose) : null,
        progress.checkpoint ? el("p", { class: "step" }, progress.checkpoint_words || progress.checkpoint) : null,
        bar("pours", progress.pours, progress.of_pours), bar("simulations", progress.simulations, progress.of_simulations),
        el("p", { class: "quiet" }, progress.line),
      ] : campaign.reason ? el("p", {}, campaign.reason) : null,
      el("p", { class: "links" },
        campaign.live ? el("a", { href: campaign.live, target: "_blank", rel: "noreferrer", "data-key": `live ${campaign.id}` },
          "Live view") : null,
        campaign.report ? button(`report ${campaign.id}`, "Save report", () => acts.report(campaign.id), "plain") : null),
      !acts.end ? null : el("div", { class: "grades" },
        button(`pause ${campaign.id}`, "Pause", () => acts.end(campaign, "pause"), "grade"),
        button(`stop ${campaign.id}`, "Finish and end", () => acts.end(campaign, "stop"), "grade"),
        button(`abort ${campaign.id}`, "Stop the motion", () => acts.end(campaign, "abort"), "grade danger")),
    ]);
}

function bar(what, done, of) {
  if (!of) return null;
  return el("label", { class: "bar" }, `${what} ${done} of ${of}`, el("progress", { value: Math.min(done, of), max: of }));
}

const NAMES = { done: "Done", yes: "Yes", no: "No", lost: "Lost: outcome unknown", repeat: "Pour it again", accept: "Leave it as it is", correct: "Correct the other amounts", "[]": "No more mixtures" };

/** A question with answers that a wet finger hits. `send` takes the answer and throws what is wrong with it; without it, others answer. */
export function questionCard(question, campaign, mode, send) {
  const problem = el("p", { class: "problem", role: "alert" }, question.problem || "");
  const answer = async (text) => {
    problem.textContent = "";
    try { await send(question, text); } catch (error) { problem.textContent = error.message; }
  };
  const head = `question-${question.id}`;
  const card = el("article", { class: "question", "aria-labelledby": head, "data-question": question.id },
    el("p", { class: "quiet" }, modeBadge(mode), ` ${campaign} at ${question.rig}, asked at ${clock(question.asked)}`),
    el("h2", { id: head, tabindex: "-1" }, question.text), problem,
    question.hands ? el("p", { class: "hands" }, "Hands go into the cell: the arm stands still until you answer.") : null,
    question.about === "vessels_laid_out" ? null : details(question.details), send ? el("div", { class: "answers" }, answers(question, answer)) : el("p", {}, "An operator answers."), diagnostics(question));
  if (send && question.kind === "bench") card.append(el("details", {}, el("summary", {}, "This pour can't be made"),
    button(`give-up-${question.id}`, "Give it up", () => answer("give up"), "plain danger")));
  return card;
}

function details(table) {
  const { diagnostics, ...facts } = table || {};
  const rows = Object.entries(facts).map(([key, value]) =>
    el("div", {}, el("dt", {}, named(key)), el("dd", {}, typeof value === "number" ? String(+value.toPrecision(5)) : String(value))));
  return rows.length ? el("dl", {}, rows) : null;
}

/** What arm and balance show now, folded: it is long, and answers nothing by itself. */
function diagnostics(question) {
  const found = question.details && question.details.diagnostics;
  return found ? el("details", {}, el("summary", { "data-key": `diagnostics-${question.id}` }, "What arm and balance show now"),
    el("ul", { class: "quiet" }, found.split("\n").map((line) => el("li", {}, line)))) : null;
}

/** 'tool_speed_mm_s' → 'tool speed [mm/s]'. */
function named(key) {
  const unit = key.match(/_(deg_s|mm_s|deg|mm|ml|g|s)$/);
  const words = (unit ? key.slice(0, unit.index) : key).replaceAll("_", " ");
  return unit ? `${words} [${unit[1].replace("_", "/")}]` : words;
}

function answers(question, answer) {
  const big = (text) => button(`answer-${question.id}-${text}`, NAMES[text] || text, () => answer(text),
    `big ${text === "done" || text === "yes" ? "go" : ""}`);
  if (question.wants === "done") return big("done");
  if (question.wants === "yes or no") return [big("yes"), big("no")];
  if (question.wants === "weight") return weights(question, ["Weight"], ([weight]) => answer(`${weight} g`));
  return question.options.map((option) => {
    if (option.startsWith("received")) return weights(question, ["Received by the cup"], ([mass]) => answer(`received ${mass} g`));
    if (option.startsWith("weighed")) return weights(question, ["Spilled", "Left in the pourer"],
      (found) => answer(`weighed ${found.map((mass) => `${mass} g`).join("; ")}`));
    return big(option);
  });
}

function weights(question, names, send) {
  const inputs = names.map((name, index) => el("input", {
    id: `weight-${question.id}-${index}`, inputmode: "decimal", autocomplete: "off", required: true, size: 6,
    pattern: "\\s*[0-9]+([.,][0-9]+)?\\s*", title: "a number of grams", "data-key": `weight-${question.id}-${index}`,
  }));
  return el("form", {
    class: "weights",
    onsubmit: (event) => { event.preventDefault(); send(inputs.map((input) => input.value.trim())); },
  }, inputs.map((input, index) => el("label", {}, names[index], el("span", {}, input, " g"))),
  el("button", { class: "big go" }, names.length > 1 ? "It was weighed" : "Send the weight"));
}

export function poursTable(pours) {
  if (!pours.length) return el("p", { class: "quiet" }, "None yet.");
  return el("table", {},
    el("thead", {}, el("tr", {}, ["Campaign", "Pour", "Into", "Action", "Expected", "Measured", "Spilled"].map((head) =>
      el("th", { scope: "col" }, head)))),
    el("tbody", {}, pours.map((pour) => el("tr", { class: pour.state.replace(" ", "-") },
      cell("Campaign", pour.campaign), cell("Pour", pour.number), cell("Into", pour.receiver), cell("Action", pour.action),
      cell("Expected", pour.predicted || "—", pour.predicted ? pour.loss : ""),
      cell("Measured", pour.measured || stateText(pour.state), pour.state === "weighed" ? pour.loss : ""),
      cell("Spilled", pour.spilled_g === null ? "—" : `${pour.spilled_g.toFixed(1)} g`)))));
}

const CUPS = { waiting: "empty", filling: "being filled", full: "done", missed: "missed", rejected: "rejected", refused: "not poured", unknown: "UNKNOWN" };

/** A place for the rack of mixtures from above and the same as a table; `fillRack` fills it, and it stays as it was scrolled and opened. */
export function rackFigure({ name }) {
  const heads = ["Cup", "Liquid", "Wanted [g]", "Received [g]", "Cup is"].map((head) => el("th", { scope: "col" }, head));
  return el("figure", { "aria-label": `rack of ${name}` }, el("figcaption", {}, el("b", {}, name)),
    el("div", { class: "wide", tabindex: "0" }, el("img", { alt: "The rack from above. The table has the same.",
      onload: ({ target }) => { target.style.minWidth = `${Math.round(0.68 * target.naturalWidth)}px`; } })),
    el("details", {}, el("summary", {}, "As a table"), el("table", {}, el("thead", {}, el("tr", {}, heads)), el("tbody", {}))));
}

/** Show a rack in its figure. The picture is an image, in which nothing can be executed. */
export function fillRack(figure, { rack, mixtures }) {
  const grams = (mass) => mass === null ? "—" : mass.toFixed(2);
  draw(figure.querySelector("tbody"), mixtures, (all) => {
    figure.querySelector("img").src = `data:image/svg+xml,${encodeURIComponent(rack)}`;
    return all.map((one) => el("tr", {}, cell("Cup", one.cup), cell("Liquid", one.liquid), cell("Wanted [g]", grams(one.wanted_g)),
      cell("Received [g]", grams(one.received_g)), cell("Cup is", CUPS[one.state])));
  });
}

/** Where the vessels stand that an arm carries, and what they hold. */
export function vesselsTable(vessels) {
  return el("table", {},
    el("thead", {}, el("tr", {}, ["Vessel", "Stands", "Holds"].map((head) => el("th", { scope: "col" }, head)))),
    el("tbody", {}, vessels.map(({ id, position, in_use: inUse, content }) => el("tr", {}, cell("Vessel", id), cell("Stands", position),
      content.mass_g === null && inUse ? cell("Holds", "", "not weighed yet") :
        cell("Holds", content.mass_g === null ? "unknown" : `${content.mass_g.toFixed(1)} g ${content.liquid}`)))));
}

const NIGHT = { consent: "Consent", pour: "Pour", accounted: "Masses", fault: "FAULT", answer: "Answer", end: "End" };

/** Unattended pours as one timeline, the newest first. */
export function nightTimeline(events) {
  const count = (kind) => events.filter((one) => one.kind === kind).length;
  const many = (number, word) => `${number} ${word}${number === 1 ? "" : "s"}`;
  return [
    el("p", {}, `${many(count("pour"), "pour")} since ${clock(events[0].time)}, ${many(count("fault"), "fault")}`),
    el("ol", { class: "night", tabindex: "0", "aria-label": "Timeline" }, [...events].reverse().map(({ time, kind, text }) =>
      el("li", { class: kind }, el("time", {}, clock(time)), el("b", {}, NIGHT[kind]), el("span", {}, text)))),
  ];
}

/** A cell; `meaning` says what its value is. */
const cell = (head, text, meaning = "") =>
  el("td", { "data-head": head }, String(text), meaning ? el("span", { class: "meaning" }, ` ${meaning}`) : null);

const followers = (item) => item.followers.length ? `, followed by ${item.followers.join(", ")}` : "";

export function queueList(items, paused, acts) {
  return [
    el("p", {}, paused ? el("b", {}, "The queue is held: nothing begins. ") : "", items.length ? "" : "Nothing waits. ",
      !acts.hold ? null : button("hold", paused ? "Let it go on" : "Hold the queue", () => acts.hold(!paused), "plain")),
    items.length ? el("ol", {}, items.map((item, index) => el("li", {}, el("span", {}, el("b", {}, item.name), " ",
      modeBadge(item.mode), ` for ${item.rig}`, item.needs_enabling ? ", waits for `decant queue enable`" : "",
      item.after ? `, after ${item.after.campaign}${item.after.verdict === "any" ? "" : ` if it is ${item.after.verdict}`}` : "", followers(item)),
    item.state === "checking" ? "is being checked" : "",
    index && acts.earlier && item.state === "queued" ? button(`up ${item.id}`, "Earlier", () => acts.earlier(item, items[index - 1]), "plain") : null,
    !acts.end ? null : button(`drop ${item.id}`, "Take out", () => acts.end(item, "stop"), "plain danger")))) : null,
  ];
}

/** What a run reached; red unless that is all that was wanted. */
const verdictText = (verdict, state) => !verdict ? stateText(state) :
  el("span", { class: verdict.word === "complete" ? "verdict" : "verdict problem" },
    verdict.text + (state === "stopped" ? ", stopped" : ""));

/** The reasons why something was not reached, folded. */
const unmetDetails = (verdict) => !verdict?.unmet.length ? null :
  el("details", {}, el("summary", {}, "What was not reached"),
    el("ul", {}, verdict.unmet.map((goal) => el("li", {}, el("b", {}, goal.of.join(", ")), `: ${goal.reason}`))));

export function endedList(items, acts) {
  if (!items.length) return el("p", { class: "quiet" }, "None.");
  return el("ul", {}, items.map((item) => el("li", {},
    el("span", {}, el("b", {}, item.name), " ", modeBadge(item.mode), " ", verdictText(item.verdict, item.state),
      item.reason ? `: ${item.reason}` : "", followers(item), item.ended ? `, ${clock(item.ended)}` : "", unmetDetails(item.verdict)),
    acts.resume && ["paused", "failed", "unknown", "stopped"].includes(item.state) ?
      button(`resume ${item.id}`, "Go on", () => acts.resume(item), "plain") : null,
    item.report ? button(`report ${item.id}`, "Save report", () => acts.report(item.id), "plain") : null)));
}

/** The latest days of a control chart, in standard deviations from its history; beyond the limits (4) is red. */
export function chartFigure(chart) {
  const days = chart.points.filter((point) => point.deviations !== null).slice(-60), last = chart.points.at(-1);
  const draw = (name, attributes) => {
    const drawn = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) drawn.setAttribute(key, value);
    return drawn;
  };
  const out = ({ time }) => chart.violations.some(({ begun, ended }) => begun <= time && (ended === null || time < ended));
  const height = (deviations) => 30 - 3.75 * Math.max(-7, Math.min(7, deviations));
  const begin = days[0]?.time, span = Math.max(last.time - begin, 86400);
  const picture = draw("svg", { viewBox: "0 0 240 60", role: "img", "aria-label": chart.text || `${chart.label}: in control` });
  picture.append(draw("rect", { class: "limits", x: 0, y: 15, width: 240, height: 30 }), ...days.filter((point) => point.pours > 1).flatMap((point) => point.value_deviations.map((value) => draw("circle", {
    class: "single", r: 1, cx: 5 + 230 * (point.time - begin) / span, cy: height(value),
  }))), ...days.map((point) => draw("circle", {
    class: out(point) ? "out" : "", r: 2, cx: 5 + 230 * (point.time - begin) / span, cy: height(point.deviations),
  })));
  return el("figure", {}, picture, el("figcaption", {}, el("b", {}, chart.label), ` ${+last.value.toPrecision(4)} ${chart.unit}, ${chart.laboratory} `,
    modeBadge(chart.mode), chart.text ? el("p", { class: "problem" }, sentence(chart.text)) : null));
}

/** Runs that were found, the newest first: what was poured, how well, what people said of it. */
export function previousRuns(runs, acts) {
  if (!runs.length) return el("p", { class: "quiet" }, "No run has all of this.");
  const best = (run) => Object.entries(run.recommended).map(([into, found]) =>
    `${into} ${found.best_loss === null ? "—" : percent(found.best_loss)}`).join(", ") || "—";
  return el("ul", {}, runs.map((run) => el("li", {},
    el("span", {}, el("b", {}, run.run), " ", modeBadge(run.mode), ` ${day(run.begun)}, ${run.state === "finished" && run.verdict ? run.verdict : stateText(run.state)}, ${run.pours} pours`,
      ` of ${run.liquid.join(", ")}, best: ${best(run)}`,
      run.notes.map((note) => el("p", { class: "quiet" }, note))),
    !acts.note ? null : button(`note ${run.run}`, "Note", () => acts.note(run), "plain"),
    button(`previous ${run.run}`, "Save report", () => acts.previousReport(run), "plain"))));
}

const day = (seconds) => new Date(1000 * seconds).toLocaleDateString([], { year: "numeric", month: "short", day: "numeric" });
