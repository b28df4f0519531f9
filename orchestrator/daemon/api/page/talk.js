// The daemon's API from the page: calls with the token, and its events as they come.

const BASE = "api/v1/";
let token = "";

export class Refused extends Error {
  constructor(status, text) { super(text); this.status = status; }
}

/** The token of the address (…#token=…) or of this tab; the address forgets it at once. */
export function knownToken() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given) {
    history.replaceState(null, "", location.pathname);
    sessionStorage.setItem("token", given);
  }
  token = sessionStorage.getItem("token") || "";
  return token;
}

export function useToken(text) {
  token = text;
  if (text) sessionStorage.setItem("token", text); else sessionStorage.removeItem("token");
}

/** One call; its answer as JSON. Throws Refused with the daemon's own words, TypeError where it can't be reached. */
export async function call(path, body, { method, timeout = 15000 } = {}) {
  const headers = { Authorization: `Bearer ${token}` };
  if (body !== undefined) headers["Content-Type"] = "application/json";
  const response = await fetch(BASE + path, {
    method: method || (body === undefined ? "GET" : "POST"), headers, cache: "no-store",
    body: body === undefined ? undefined : JSON.stringify(body), signal: AbortSignal.timeout(timeout),
  });
  if (response.ok) return response.json();
  let detail = response.statusText;
  try { detail = (await response.json()).detail; } catch { /* not ours: a proxy's page */ }
  if (Array.isArray(detail)) detail = detail.map((one) => one.msg).join("; ");
  throw new Refused(response.status, detail);
}

/** Whether the daemon answers now: throws where it does not within so long [ms]. Needs no token. */
export async function reach(timeout = 5000) {
  const response = await fetch("healthz", { cache: "no-store", signal: AbortSignal.timeout(timeout) });
  if (!response.ok) throw new Refused(response.status, response.statusText);
}

/** A run's report, saved as a file: it is a page of its own, which this one's rules would not let work. */
export async function saveReport(campaign, kind = "campaigns") {
  const response = await fetch(`${BASE}${kind}/${encodeURIComponent(campaign)}/report`,
    { headers: { Authorization: `Bearer ${token}` } });
  if (!response.ok) throw new Refused(response.status, "there is no report yet");
  const link = document.createElement("a");
  link.href = URL.createObjectURL(await response.blob());
  link.download = `${campaign}.html`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}

/** Events from now on, and again after the connection was lost; `told` gets type and data, `linked` whether it stands. */
export async function listen(told, linked) {
  let last = null, pause = 500;
  for (;;) {
    const silence = new AbortController();
    let watchdog = 0;
    const alive = () => { clearTimeout(watchdog); watchdog = setTimeout(() => silence.abort(), 40000); };
    try {
      alive();
      const headers = { Authorization: `Bearer ${token}`, ...(last === null ? {} : { "Last-Event-ID": last }) };
      const response = await fetch(BASE + "events", { headers, cache: "no-store", signal: silence.signal });
      if (response.status === 401) throw new Refused(401, "this token is not known any more");
      if (!response.ok) throw new Refused(response.status, response.statusText);
      linked(true);
      pause = 500;
      const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
      let rest = "";
      for (;;) {
        const { value, done } = await reader.read();
        if (done) break;
        alive();
        const blocks = (rest + value).split("\n\n");
        rest = blocks.pop();
        for (const block of blocks) {
          const lines = Object.fromEntries(block.split("\n").map((line) => {
            const at = line.indexOf(": ");
            return [line.slice(0, at), line.slice(at + 2)];
          }));
          if (lines.id) { last = lines.id; told(lines.event, JSON.parse(lines.data)); }
        }
      }
    } catch (error) {
      if (error.status === 401) { linked(false, error); return; }
    } finally {
      clearTimeout(watchdog);
    }
    linked(false);
    await new Promise((go) => setTimeout(go, pause));
    pause = Math.min(2 * pause, 5000);
  }
}
