"""A headless Chromium over its DevTools pipe: opens a page as a screen, a phone or a sheet of paper, and measures it."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
#: Width of the text of an A4 page with margins of 12 mm [px of CSS].
PAPER = 703
#: The DevTools protocol is spoken over file descriptors 3 and 4 of the browser.
LAUNCH = (
    "import fcntl, os, sys; r, w = (fcntl.fcntl(int(x), fcntl.F_DUPFD, 10) for x in sys.argv[1:3]); "
    "os.dup2(r, 3); os.dup2(w, 4); os.execvp(sys.argv[3], sys.argv[3:])"
)


def found():
    """The browser of this machine, if it has one."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Browser:
    """One browser with one page, for as long as the block lasts."""

    def __enter__(self):
        self.home = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        theirs, self.out = os.pipe()
        self.back, others = os.pipe()
        flags = ["headless", "no-sandbox", "disable-gpu", "no-first-run", "hide-scrollbars", "remote-debugging-pipe"]
        flags = [f"--{flag}" for flag in (*flags, f"user-data-dir={self.home.name}")]
        self.process = subprocess.Popen(
            [sys.executable, "-c", LAUNCH, str(theirs), str(others), found() or "chromium", *flags, "about:blank"],
            pass_fds=(theirs, others), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(theirs), os.close(others)
        self.count, self.rest = 0, b""
        self.events: list[dict] = []
        self.session: str | None = None
        target = self("Target.createTarget", url="about:blank")["targetId"]
        self.session = self("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self(f"{domain}.enable")
        return self

    def __exit__(self, *_):
        os.close(self.out), os.close(self.back)
        self.process.terminate()
        self.process.wait(timeout=20)
        self.home.cleanup()

    def _next(self):
        while b"\0" not in self.rest:
            if not (more := os.read(self.back, 1 << 20)):
                raise RuntimeError("the browser has gone")
            self.rest += more
        first, self.rest = self.rest.split(b"\0", 1)
        return json.loads(first)

    def __call__(self, method, **params):
        """Call a method of the protocol. What happens meanwhile is kept in `events`."""
        self.count += 1
        mine = {"id": self.count, "method": method, "params": params}
        if self.session:
            mine["sessionId"] = self.session
        os.write(self.out, json.dumps(mine).encode() + b"\0")
        while (got := self._next()).get("id") != self.count:
            self.events.append(got)
        if "error" in got:
            raise RuntimeError(f"{method}: {got['error']}")
        return got["result"]

    def open(self, page, width, *, height=900, media="screen", dark=False):
        """Open a page at a width [px of CSS], on a screen or in `print`."""
        self.events.clear()
        self("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self("Emulation.setEmulatedMedia", media=media, features=[scheme])
        self("Page.navigate", url=Path(page).resolve().as_uri())
        while not any(e["method"] == "Page.loadEventFired" for e in self.events):
            self.events.append(self._next())

    def value(self, script):
        """What an expression in the page is. It has to be of JSON."""
        got = self("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in got:
            raise RuntimeError(got["exceptionDetails"]["exception"].get("description", "?"))
        return got["result"].get("value")

    def complaints(self):
        """Errors of the console and of scripts, and requests that leave the file, since the page was opened."""
        said = []
        for event in self.events:
            method, p = event["method"], event.get("params", {})
            if method == "Runtime.exceptionThrown":
                said.append(p["exceptionDetails"].get("exception", {}).get("description", "exception"))
            elif method == "Log.entryAdded" and p["entry"]["level"] == "error":
                said.append(p["entry"]["text"])
            elif method == "Runtime.consoleAPICalled" and p["type"] in ("error", "assert"):
                said.append(str(p["args"]))
            elif method == "Network.requestWillBeSent" and not p["request"]["url"].startswith(
                ("file:", "data:", "about:")
            ):
                said.append(f"request to {p['request']['url']}")
        return said

    def picture(self, path):
        """The whole page as PNG."""
        got = self("Page.captureScreenshot", captureBeyondViewport=True)
        Path(path).write_bytes(base64.b64decode(got["data"]))


#: What is wrong with a page as it is laid out: {kind: [where]}.
MEASURE = r"""
(() => {
  const wrong = {sideways: [], outside: [], clipped: [], overlapping: [], contrast: [], small: []};
  const width = document.documentElement.clientWidth, paper = matchMedia("print").matches;
  const least = width < 400 ? 10.95 : 9.95;
  if (document.documentElement.scrollWidth > width + 1) wrong.sideways.push(document.documentElement.scrollWidth);
  const name = e => (e.textContent || "").trim().replace(/\s+/g, " ").slice(0, 50) + " <" + (e.parentElement || e).tagName + ">";
  const scrolls = e => { for (; e; e = e.parentElement) if (["auto", "scroll"].includes(getComputedStyle(e).overflowX)) return true; };
  const rgba = text => { const m = text.match(/[\d.]+/g); return m && [+m[0], +m[1], +m[2], m[3] === undefined ? 1 : +m[3]]; };
  const light = c => c.slice(0, 3).map(x => x / 255).map(x => x <= .03928 ? x / 12.92 : ((x + .055) / 1.055) ** 2.4)
    .reduce((s, x, i) => s + x * [.2126, .7152, .0722][i], 0);
  const behind = e => { for (; e; e = e.parentElement) { const c = rgba(getComputedStyle(e).backgroundColor); if (c && c[3] > .99) return c; } return [255, 255, 255, 1]; };
  const boxes = [];
  const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walk.nextNode()) {
    const node = walk.currentNode, e = node.parentElement;
    if (!node.data.trim() || ["SCRIPT", "STYLE"].includes(e.tagName)) continue;
    const style = getComputedStyle(e), drawn = e.closest("svg");
    if (style.visibility === "hidden" || (e.closest("details:not([open])") && !e.closest("summary"))) continue;
    const range = document.createRange();
    range.selectNodeContents(node);
    const rects = [...range.getClientRects()].filter(r => r.width > 1 && r.height > 1);
    if (!rects.length) continue;
    for (const r of rects) {
      if ((r.right > width + 1 || r.left < -1) && (paper || !scrolls(e))) { wrong.outside.push(name(node)); break; }
    }
    for (let p = e; p && p !== document.body; p = p.parentElement) {
      const s = getComputedStyle(p);
      if (s.overflowX === "hidden" && p.tagName !== "svg" && rects.some(r => r.right > p.getBoundingClientRect().right + 1)) wrong.clipped.push(name(node));
    }
    let size = parseFloat(style.fontSize), turned = false;
    if (drawn) {
      const m = e.getScreenCTM();
      size *= Math.hypot(m.a, m.b);
      turned = Math.min(Math.abs(m.a), Math.abs(m.b)) > .02 * Math.hypot(m.a, m.b);
      const whole = drawn.getBoundingClientRect();
      for (const r of rects) if (r.right > whole.right + 2 || r.left < whole.left - 2 || r.bottom > whole.bottom + 2 || r.top < whole.top - 2) { wrong.clipped.push(name(node) + " of " + (drawn.closest("figure") || {}).id); break; }
      if (!paper && size < least && e.tagName === "text") wrong.small.push(size.toFixed(1) + " " + name(node) + " of " + (drawn.closest("figure") || {}).id);
    } else if (!paper && size < least) wrong.small.push(size.toFixed(1) + " " + name(node));
    const ink = rgba(drawn ? style.fill : style.color), ground = drawn ? [255, 255, 255, 1] : behind(e);
    if (ink && !(drawn && light(ink) > .8)) {
      const [a, b] = [light(ink), light(ground)].sort((x, y) => y - x), ratio = (a + .05) / (b + .05);
      if (ratio < (size >= 24 || (size >= 18.66 && +style.fontWeight >= 700) ? 3 : 4.5) - .01) wrong.contrast.push(ratio.toFixed(2) + " " + name(node) + (drawn ? " of " + (drawn.closest("figure") || {}).id : ""));
    }
    if (!turned) for (const r of rects) boxes.push([r, node, drawn]);
  }
  boxes.sort((a, b) => a[0].top - b[0].top);
  const deep = .25;  // of the smaller of two boxes, by which they may lie over one another: ascenders, descenders
  for (let i = 0; i < boxes.length; i++) for (let j = i + 1; j < boxes.length && boxes[j][0].top < boxes[i][0].bottom; j++) {
    const [a, m, s] = boxes[i], [b, n, t] = boxes[j];
    if (m === n || s !== t) continue;
    const w = Math.min(a.right, b.right) - Math.max(a.left, b.left), h = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
    if (w > Math.max(2, .05 * Math.min(a.width, b.width)) && h > deep * Math.min(a.height, b.height)) wrong.overlapping.push(name(m) + " | " + name(n) + (s ? " of " + (s.closest("figure") || {}).id : ""));
  }
  for (const kind in wrong) wrong[kind] = [...new Set(wrong[kind])];
  return wrong;
})()
"""
