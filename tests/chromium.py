"""Opens a page in headless Chromium and asks it questions, for tests."""

import json
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="headless Chromium is not installed (apt-get install chromium)"
)

ASK = """
<script>
window.problems = [];
addEventListener("error", (e) => problems.push(String(e.message)));
addEventListener("unhandledrejection", (e) => problems.push(String(e.reason)));
console.error = (...said) => problems.push(said.join(" "));
</script>
"""
TELL = """
<script>
(async () => {
  const ready = () => document.documentElement.dataset.ready === "yes";
  for (let k = 0; k < 400 && !ready(); k++) await new Promise(r => setTimeout(r, 50));
  let answer = null;
  try { answer = await (async () => { %s })(); } catch (e) { problems.push(String(e)); }
  const place = document.createElement("pre");
  place.id = "answer";
  place.textContent = JSON.stringify({ answer, problems });
  document.body.append(place);
})();
</script>
"""


def ask(page: Path, script: str, width: int = 1200) -> tuple[Any, list[str]]:
    """Return what a script returns in a page once it is drawn, and the page's errors."""
    text = page.read_text(encoding="utf-8")
    text = text.replace("<head>", f"<head>{ASK}", 1) + TELL % script
    copy = page.with_name("asked.html")
    copy.write_text(text, encoding="utf-8")
    assert CHROMIUM is not None
    command = [
        CHROMIUM, "--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader", f"--window-size={width},2000",
        "--virtual-time-budget=60000", "--dump-dom", copy.resolve().as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)  # noqa: S603
    found = re.search(r'<pre id="answer">(.*?)</pre>', done.stdout, re.S)
    assert found is not None, done.stderr[-2000:]
    said = json.loads(unescape(found.group(1)))
    return said["answer"], said["problems"]
