"""A headless Chromium for tests, Debian's own, that records what a page logs and asks the network for.

python -m tests.report.browser install    # Debian's packages, as root
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from selenium import webdriver
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service

PROGRAMS = {"chromium": "chromium", "chromedriver": "chromium-driver"}  # program -> Debian package
HEIGHTS = {390: 844, 1280: 900}  # a phone's and a laptop's window by width, in CSS pixels
LOCAL = ("data:", "file:", "about:", "chrome:", "blob:")


def missing() -> list[str]:
    """Programs that are not installed."""
    return [name for name in PROGRAMS if shutil.which(name) is None]


def install() -> int:
    """Install what is missing."""
    if not missing():
        return 0
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    for command in (["update", "-qq"], ["install", "-y", "-qq", "--no-install-recommends", *PROGRAMS.values()]):
        if code := subprocess.run(["apt-get", *command], env=environment, check=False).returncode:
            return code
    return 0


class Browser:
    """One Chromium; `open` a file, then ask what happened."""

    def __init__(self) -> None:
        options = Options()
        options.binary_location = shutil.which("chromium") or ""
        for flag in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu", "--hide-scrollbars"):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        # Named, so that Selenium neither looks for a driver nor downloads one.
        self.driver = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))

    def quit(self) -> None:
        """End it."""
        self.driver.quit()

    def open(self, page: Path, width: int, dark: bool = False) -> None:
        """Load `page` from disk in a window of `width` CSS pixels, forgetting what was recorded before."""
        mobile, height = width < 600, HEIGHTS[width]
        metrics = {"width": width, "height": height, "deviceScaleFactor": 2 if mobile else 1, "mobile": mobile}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})
        self.driver.get("about:blank")
        for kind in ("browser", "performance"):
            self.driver.get_log(kind)
        self.driver.get(page.resolve().as_uri())

    def ask(self, script: str) -> object:
        """What the JavaScript expression `script` is in the page; the page's policy does not bind it."""
        return self.driver.execute_script(f"return {script}")

    def console(self) -> list[str]:
        """Everything the page logged since it was opened, errors and policy violations among it."""
        return [entry["message"] for entry in self.driver.get_log("browser")]

    def requests(self) -> list[str]:
        """Addresses that the page asked for since it was opened, blocked ones among them."""
        messages = [json.loads(entry["message"])["message"] for entry in self.driver.get_log("performance")]
        return [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]


if __name__ == "__main__":
    if sys.argv[1:] != ["install"]:
        sys.exit("usage: python -m tests.report.browser install")
    sys.exit(install())
