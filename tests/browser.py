"""A headless Chromium, told what to do by the DevTools protocol over two pipes: no port, no other package."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

# SwiftShader draws WebGL without a graphics card. Root, as in a container, needs no sandbox.
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--remote-debugging-pipe",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage",
    "--disable-extensions",
    "--disable-background-networking",
    "--hide-scrollbars",
    "--no-first-run",
)
SECONDS = 120.0  # until an answer is given up
PAGE_HAS_GONE = -32000  # what a call is answered whose page, or its script, has gone meanwhile


def executable() -> str | None:
    """Return where a Chromium is installed, if it is."""
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


class ProtocolError(RuntimeError):
    """The browser has refused a call of its protocol."""

    def __init__(self, error: dict[str, Any]) -> None:
        super().__init__(str(error))
        self.code = error["code"]


@dataclass
class Page:
    """One tab of a browser: what it wrote to its console as an error, and what it asked the network for."""

    process: subprocess.Popen[bytes]
    to_browser: int
    from_browser: int
    session: str = ""
    errors: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)
    loaded: bool = False
    _number: int = 0
    _rest: bytes = b""

    def call(self, method: str, **parameters: Any) -> Any:
        """Call a method of the protocol and return its result."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        data = json.dumps(message).encode() + b"\0"
        while data:
            data = data[os.write(self.to_browser, data) :]
        return self._until(self._number)

    def _until(self, number: int) -> Any:
        ends = time.monotonic() + SECONDS
        while time.monotonic() < ends:
            *messages, self._rest = self._rest.split(b"\0")
            answer = None
            for text in messages:
                message = json.loads(text)
                if message.get("id") == number:
                    answer = message
                elif "method" in message:
                    self._heard(message["method"], message["params"])
            if answer is not None:
                if "error" in answer:
                    raise ProtocolError(answer["error"])
                return answer["result"]
            more = os.read(self.from_browser, 1 << 20)
            if not more:
                raise RuntimeError("the browser has ended")
            self._rest += more
        raise TimeoutError(f"no answer to call {number}")

    def _heard(self, method: str, params: Any) -> None:
        if method == "Page.loadEventFired":
            self.loaded = True
        elif method == "Runtime.exceptionThrown":
            details = params["exceptionDetails"]
            self.errors.append(details.get("exception", {}).get("description", details["text"]))
        elif method == "Runtime.consoleAPICalled" and params["type"] in ("error", "assert"):
            self.errors.append(" ".join(str(a.get("value", a.get("description"))) for a in params["args"]))
        elif method == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.errors.append(params["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])

    def open(self, path: Path | str, width: int = 1280, *, dark: bool = False, printed: bool = False) -> None:
        """Open a file, or an address, at a width (CSS pixels) and wait until it and its bodies are there."""
        self.errors.clear()
        self.requests.clear()
        self.loaded = False
        self.resize(width)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", media="print" if printed else "", features=[scheme])
        self.call("Page.navigate", url=path if isinstance(path, str) else path.resolve().as_uri())
        self.wait("document.readyState === 'complete'")
        self.wait("!document.querySelector('.viewer[data-state=loading]')")

    def resize(self, width: int) -> None:
        """Show it in a window of another width (CSS pixels)."""
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=width < 600
        )

    def run(self, script: str) -> Any:
        """Evaluate JavaScript, also a promise, and return its value."""
        result = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in result:
            raise RuntimeError(result["exceptionDetails"].get("exception", {}).get("description", "error"))
        return result["result"].get("value")

    def wait(self, condition: str) -> None:
        """Wait until a condition in JavaScript holds.

        Where the page loads anew meanwhile, the script that asks goes with the old page: it is asked again.
        """
        ends = time.monotonic() + SECONDS
        while not self._holds(condition):
            if time.monotonic() > ends:
                raise TimeoutError(condition)
            time.sleep(0.05)

    def _holds(self, condition: str) -> bool:
        try:
            return bool(self.run(f"Boolean({condition})"))
        except ProtocolError as error:
            if error.code != PAGE_HAS_GONE:
                raise
            return False

    def drag(self, x: float, y: float, dx: float, dy: float) -> None:
        """Press the left button at a place of the window, move, and release."""
        at = {"button": "left", "buttons": 1, "clickCount": 1}
        self.call("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, **at)
        for k in range(1, 5):
            self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x + dx * k / 4, y=y + dy * k / 4, **at)
        self.call("Input.dispatchMouseEvent", type="mouseReleased", x=x + dx, y=y + dy, **at)

    def screenshot(self, path: Path, selector: str = "", *, whole: bool = False) -> bytes:
        """Write a PNG of the window, of one element or of the whole page."""
        options: dict[str, Any] = {"format": "png"}
        if selector or whole:
            box = self.run(
                f"(() => {{ const b = document.querySelector({json.dumps(selector or 'html')}).getBoundingClientRect();"
                " return {x: b.x + scrollX, y: b.y + scrollY, width: b.width, height: b.height, scale: 1}; })()"
            )
            options |= {"clip": box, "captureBeyondViewport": True}
        data = base64.b64decode(self.call("Page.captureScreenshot", **options)["data"])
        path.write_bytes(data)
        return data


@contextlib.contextmanager
def browser() -> Iterator[Page]:
    """Start a browser with one empty tab, and end it."""
    found = executable()
    assert found is not None, "no Chromium is installed"
    # It reads from its descriptor 3 and writes to 4.
    read_by_it, to_it = os.pipe()
    from_it, written_by_it = os.pipe()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        shell = f'exec "$0" "$@" 3<&{read_by_it} 4>&{written_by_it}'
        process = subprocess.Popen(
            ["/bin/bash", "-c", shell, found, *FLAGS, f"--user-data-dir={profile}", "about:blank"],
            pass_fds=(read_by_it, written_by_it),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(read_by_it)
        os.close(written_by_it)
        page = Page(process, to_it, from_it)
        try:
            target = next(t for t in page.call("Target.getTargets")["targetInfos"] if t["type"] == "page")
            session = page.call("Target.attachToTarget", targetId=target["targetId"], flatten=True)["sessionId"]
            page.session = session
            for domain in ("Page", "Runtime", "Log", "Network"):
                page.call(f"{domain}.enable")
            yield page
        finally:
            page.session = ""
            with contextlib.suppress(Exception):
                page.call("Browser.close")
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(10)
            process.kill()
            os.close(to_it)
            os.close(from_it)


# The words that are read at once, numbers and units among them, without the controls of the body.
FIRST_SCREEN = """[...document.querySelectorAll('.top')].flatMap((top) => {
    const walker = document.createTreeWalker(top, NodeFilter.SHOW_TEXT), found = [];
    while (walker.nextNode()) {
        const node = walker.currentNode, range = document.createRange(), inside = node.parentElement;
        range.selectNodeContents(node);
        const read = !inside.matches('details') && !inside.closest('.viewer, script, style, svg');
        if (read && inside.checkVisibility() && range.getClientRects().length)
            found.push(...node.textContent.split(/\\s+/).filter((word) => /[\\p{L}\\p{N}]/u.test(word)));
    }
    return found;
}).join(' ')"""
WORDS = 120  # of the first screen


def without_fault(page: Page, report: Path) -> None:
    """Open a report on a telephone, then on a screen, light, dark and printed: what is wrong with it fails.

    Colours and what is printed do not depend on the width.
    """
    viewers = "[...document.querySelectorAll('.viewer')]"
    # Whoever cannot see hears what each picture and control is.
    unnamed = "img:not([alt]), img[alt=''], button:not([aria-label]):empty, canvas:not([aria-label])"
    page.open(report, 390)
    for width in (390, 1280):
        page.resize(width)
        for media, scheme in (("", "light"), ("", "dark"), ("print", "light"))[: 1 if width == 390 else 3]:
            page.call(
                "Emulation.setEmulatedMedia", media=media, features=[{"name": "prefers-color-scheme", "value": scheme}]
            )
            page.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
            said = f"{report} at {width}, {media} {scheme}"
            assert page.errors == [], said
            assert [url for url in page.requests if not url.startswith(("file:", "data:", "blob:"))] == [], said
            assert page.run(f"{viewers}.map((v) => v.dataset.why || 'ready').filter((w) => w !== 'ready')") == [], said
            if media == "print":
                assert page.run(f"{viewers}.every((v) => v.querySelectorAll('.stills img').length > 0)"), said
            else:  # nothing is wider than the window
                assert page.run("document.documentElement.scrollWidth") <= width, said
                assert len((first := page.run(FIRST_SCREEN)).split()) <= WORDS, first
        assert page.run(f"document.querySelectorAll({json.dumps(unnamed)}).length") == 0, said
        assert page.run("document.querySelectorAll('h1').length") == 1, said
