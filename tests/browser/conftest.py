"""A real browser, and the page of a result in it. Without Chromium these tests fail."""

import contextlib
import shutil
from dataclasses import dataclass, field

import pytest
from playwright.sync_api import Page, sync_playwright


@dataclass
class Opened:
    """A page, what it wrote to the console, and what it asked the network for."""

    page: Page
    messages: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def live(self, name):
        """Bring a figure into view and wait until it is drawn."""
        box = f".live[data-name='{name}']"
        self.page.locator(box).scroll_into_view_if_needed()
        self.page.wait_for_selector(f"{box}[data-ready]", timeout=30000)
        return self.page.locator(box)

    def js(self, name, expression):
        """The value of an expression in which ``live`` is the figure."""
        return self.page.evaluate(
            """([name, text]) => {
              const live = document.querySelector(`.live[data-name="${name}"]`).live;
              return new Function("live", "return " + text)(live);
            }""",
            [name, expression],
        )


@pytest.fixture(scope="session")
def chromium():
    path = shutil.which("chromium") or shutil.which("chromium-browser")
    assert path, "these tests need Chromium from the system's packages: apt-get install chromium"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def open_page(chromium, tmp_path):
    """A function that opens HTML from disk."""
    with contextlib.ExitStack() as stack:

        def opened(html, width=1280, **options):
            file = tmp_path / "report.html"
            file.write_text(html, encoding="utf-8")
            context = chromium.new_context(
                viewport={"width": width, "height": 900}, offline=True, **options
            )
            stack.callback(context.close)
            found = Opened(context.new_page())
            found.page.on(
                "console",
                lambda m: m.type in ("error", "warning") and found.messages.append(m.text),
            )
            found.page.on("pageerror", lambda error: found.messages.append(str(error)))
            found.page.on("request", lambda request: found.requests.append(request.url))
            found.page.goto(file.as_uri())
            return found

        yield opened
