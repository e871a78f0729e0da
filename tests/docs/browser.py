"""Pictures of a page as a browser shows it, for what Evedrop's own drawing cannot do: the light theme, and reports on paper.

The browser is Chromium, if the machine has it.
"""

from __future__ import annotations

import asyncio
import base64
import json
import re
import shutil
import subprocess
import sys
import tempfile
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tornado.websocket import WebSocketClientConnection, websocket_connect

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
_OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
)
_BAR = 28
"""Pixels of the viewer's time panel, which is left out."""
_ROUNDS, _PAUSE, _EQUAL = 120, 1.0, 3
"""Pictures that are taken at most, seconds between them, and equal ones after which the page is complete."""
_MOST_BYTES = 2**27
_PATIENCE_SECONDS = 120.0


@contextmanager
def _viewed(results: Path) -> Iterator[str]:
    """The address at which `evedrop view` shows results."""
    command = [sys.executable, "-um", "evedrop", "view", str(results), "--view", "web"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as viewing:
        try:
            assert viewing.stdout is not None
            yield next(address[0] for line in viewing.stdout if (address := re.search(r"http://\S+", line)))
        finally:
            viewing.terminate()


@contextmanager
def _tab(folder: str) -> Iterator[str]:
    """The address of a new browser's only tab, for its debugger; folder: for what the browser writes."""
    assert CHROMIUM is not None
    command = [CHROMIUM, *_OPTIONS, f"--user-data-dir={folder}", "about:blank"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as browser:
        try:
            assert browser.stderr is not None
            port = next(
                found[1] for line in browser.stderr if (found := re.search(r"listening on ws://[^:]+:(\d+)/", line))
            )
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
                yield next(tab["webSocketDebuggerUrl"] for tab in json.load(answer) if tab["type"] == "page")
        finally:
            browser.terminate()


async def _called(tab: WebSocketClientConnection, method: str, **parameters: Any) -> dict[str, Any]:
    await tab.write_message(json.dumps({"id": 1, "method": method, "params": parameters}))
    while True:
        answer = json.loads(await tab.read_message() or "{}")
        if answer.get("id") == 1:
            result: dict[str, Any] = answer.get("result", {})
            return result


async def _complete(address: str, url: str, width: int, height: int) -> bytes:
    """A picture of a page that no longer changes, as PNG."""
    tab = await websocket_connect(address, max_message_size=_MOST_BYTES)
    clip = {"x": 0, "y": 0, "width": width, "height": height, "scale": 1}
    size = {"width": width, "height": height + _BAR, "deviceScaleFactor": 1, "mobile": False}
    await _called(tab, "Emulation.setDeviceMetricsOverride", **size)
    await _called(tab, "Page.navigate", url=url)
    picture, equal = b"", 0
    for _ in range(_ROUNDS):
        await asyncio.sleep(_PAUSE)
        new = base64.b64decode((await _called(tab, "Page.captureScreenshot", format="png", clip=clip))["data"])
        equal = equal + 1 if new == picture and len(new) > 20_000 else 0
        picture = new
        if equal == _EQUAL:
            break
    tab.close()
    return picture


def light_scene(results: Path, size: str, picture: Path) -> None:
    """Draw the first tab of the view of some results in the light theme, at the end of the results."""
    width, height = map(int, size.split("x"))
    with (
        _viewed(results) as url,
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        _tab(folder) as tab,
    ):
        light = url.replace("theme=dark", "theme=light")
        picture.write_bytes(asyncio.run(_complete(tab, light, width, height)))


def printed(page: Path, pdf: Path) -> None:
    """Print a page of a file to a PDF. Raises OSError if the browser cannot."""
    assert CHROMIUM is not None
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--no-pdf-header-footer", f"--print-to-pdf={pdf}"]
    command = [CHROMIUM, *options, page.resolve().as_uri()]
    try:
        subprocess.run(command, check=True, capture_output=True, timeout=_PATIENCE_SECONDS)
    except subprocess.SubprocessError as error:
        raise OSError(f"Chromium prints no {page.name}: {error}") from error
    if not pdf.exists() or not pdf.read_bytes().startswith(b"%PDF"):
        raise OSError(f"Chromium prints no {page.name}: what it wrote is no PDF")
