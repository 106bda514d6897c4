"""Helpers for tests of the operator's page in a browser."""

from __future__ import annotations

import base64
import os
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from weakref import WeakKeyDictionary

import numpy as np
import pytest

import rig

sync_api = pytest.importorskip("playwright.sync_api")

SCREENSHOTS = os.environ.get("TOD_SCREENSHOTS")  # directory to keep them in


until = partial(rig.until, every_s=0.1)  # each poll costs the browser time

# Chromium ends its requests whenever an address is added to the machine, as tests with link=netns do beside these.
# A page that lacks a file then loads again by itself.
NETWORK_CHANGED = "net::ERR_NETWORK_CHANGED"


# Sound is blocked until a press, as in a browser that a person uses: Playwright's `evaluate` counts as one.
SOUND_BLOCKED = """
  let isPressed = false;
  for (const kind of ["keydown", "pointerdown"]) addEventListener(kind, () => (isPressed = true), { capture: true });
  AudioContext = class extends AudioContext {
    constructor(...words) { super(...words); if (!isPressed) super.suspend(); }
    get state() { return isPressed ? super.state : "suspended"; }
    resume() { return isPressed ? super.resume() : Promise.reject(new Error("blocked")); }
  };
"""


@contextmanager
def opened(browser, url, width=1280, height=800, refused=False, script="", **context):
    """A page in its own browser context, which must stay free of errors and contact no other host.

    refused  the station goes offline in between, which the browser logs for each request
    script   runs before the page's own
    """
    with browser.new_context(viewport={"width": width, "height": height}, **context) as tab:
        wrong, own = _wrong.setdefault(tab, []), (url.partition("#")[0], "data:", "blob:")
        tab.on("weberror", lambda error: wrong.append(str(error.error)))
        tab.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
        tab.on("request", lambda request: request.url.startswith(own) or wrong.append(request.url))
        tab.add_init_script(script)
        page = tab.new_page()
        visit(page, url)
        assert rig.passes(lambda: has_started(page)), (wrong, loaded(page))
        with checked(page, refused):
            yield page


_wrong = WeakKeyDictionary()  # by browser context: errors, and addresses of other hosts


# Both wait for the page's worker, which a test may have stopped.
STATE = "Promise.all([tod.measure(), tod.birdseye()])"


@contextmanager
def checked(page, refused=False):
    """The page must have stayed free of errors; see `opened`."""
    wrong = _wrong[page.context]
    try:
        yield
    except BaseException:
        with suppress(sync_api.Error):
            print(page.evaluate(f"Promise.race([{STATE}, new Promise((end) => setTimeout(end, 1000))])"))
        raise
    expected = ["WebSocket connection", "net::ERR_" if refused else NETWORK_CHANGED]
    expected += ["'globalThis.boot' as it is undefined"] * any(NETWORK_CHANGED in text for text in wrong)
    unexpected = [text for text in wrong if not any(each in text for each in expected)]
    assert not unexpected, unexpected


class SharedPage:
    """A page that tests share: to open one takes a second and a half of processor time."""

    def __init__(self, browser, url):
        self._browser, self._url = browser, url
        self._stack = ExitStack()
        self.page = None

    def open(self):
        self.page = self.page or self._stack.enter_context(opened(self._browser, self._url))
        return self.page

    def close(self):
        self.page = None
        self._stack.close()


def visit(page, url):
    _load(lambda: page.goto(url))


def visit_again(page):
    _load(page.reload)


def _load(load):
    def is_loaded():
        try:
            return load() or True
        except sync_api.Error as error:
            if NETWORK_CHANGED not in error.message:
                raise

    until(is_loaded)


# Of a page that loads again, as when an address is added to this machine: while it does, and before its module has run.
LOADING = ("Execution context was destroyed", "tod is not defined")


def when(page, condition):
    """Wait for a JavaScript expression; also through a load, and as a function, which the pages' policy lets poll."""
    page.wait_for_function(f"() => {condition}", timeout=1000 * rig.WAIT_S)


def has_started(page):
    """Whether the page's main module has run; not if the page loads again meanwhile."""
    try:
        return page.evaluate("window.tod !== undefined")
    except sync_api.Error as error:
        if LOADING[0] not in error.message:
            raise
        return False


def loaded(page):
    """Why a page may not have started: its address and state, and each resource with its status and times, ms."""
    return page.evaluate("""() => [location.href, document.readyState, performance.getEntriesByType("resource").map(
        ({ name, responseStatus, startTime, duration }) => [name, responseStatus, startTime, duration])]""")


def take_control(page, button="#take-control"):
    def taken():
        """As a user would, click again if the page was still connecting, and confirm if asked."""
        if page.evaluate("tod.control") == "you":
            return True
        confirm = page.locator("#confirm-yes")
        with suppress(sync_api.TimeoutError):  # the dialog may open late, if the holder became known between two clicks
            if not confirm.is_visible():
                page.locator(button).click(timeout=2000)
            if confirm.is_visible():
                confirm.click(timeout=2000)
        return rig.passes(lambda: page.evaluate("tod.control === 'you'"), seconds=2)

    until(taken)


def measure(page):
    def measured():
        try:
            return page.evaluate("tod.measure()")["cameras"]  # empty before hello
        except sync_api.Error as error:
            if not any(why in error.message for why in ("does not answer", *LOADING)):
                raise

    return until(measured)


def all_live(page, seconds=rig.WAIT_S):
    """Wait until every camera has been live once; on a busy machine they are rarely all live together."""
    waiting = set(measure(page))

    def seen():
        waiting.difference_update(name for name, camera in measure(page).items() if camera["status"] == "live")
        return not waiting

    if not rig.passes(seen, seconds):
        assert {name: camera for name, camera in measure(page).items() if name in waiting} == {}, page.evaluate(
            "[tod.state, tod.sample, tod.measure()]"
        )


def state(page):
    """The vehicle's state, once it is online: a machine that was held up may show it offline for a moment."""
    return state_when(page, lambda now: True)


def state_when(page, wanted, seconds=rig.WAIT_S):
    return until(lambda: (now := page.evaluate("tod.state")) and now["online"] and wanted(now) and now, seconds)


def luma(page, camera):
    """The last picture drawn: its luma, and its capture time, ms."""
    picture = page.evaluate(f"tod.picture('{camera}')")
    width, height = picture["width"], picture["height"]
    data = np.frombuffer(base64.b64decode(picture["luma"]), np.uint8)
    return data.reshape(height, width), picture["captured"]


BOXES = """() => {
  const box = (element) => {
    const { x, y, width, height } = element.getBoundingClientRect();
    return { x, y, width, height };
  };
  const isSeen = (element) => element.checkVisibility() && box(element).width > 0;
  const find = (selector) => [...document.querySelectorAll(selector)].filter(isSeen);
  const isOutside = ({ x, y, width, height }) =>
    Math.min(x, y, innerWidth - x - width, innerHeight - y - height) < -1;
  const isRead = ({ clientWidth }) => clientWidth > 1; // others are for screen readers
  const isCut = (element) => isRead(element) && element.scrollWidth > element.clientWidth + 1;
  const isLow = ({ scrollHeight, clientHeight }) => scrollHeight > clientHeight + 1;
  const named = ({ id, className, tagName, textContent }) => `${id || className || tagName}: ${textContent}`;
  const seen = ".tile, .picture, #header > *, #side, #drive *, #messages *";
  const panels = "#side > [role=tabpanel]:not(#news-panel), dialog[open]";
  const inputs = "#side :is(input, button, label)";
  const texts = `#drive *, #messages *, .tile .head, .tile .head *, .tile .caption, #header *, ${inputs}`;
  const leavesPanel = (element) => {
    const [own, panel] = [element, document.querySelector("#side")].map((each) => each.getBoundingClientRect());
    return own.left < panel.left - 1 || own.right > panel.right + 1;
  };
  const measured = () => {
    const { scrollWidth, scrollHeight } = document.scrollingElement;
    return [
      Object.fromEntries(find(".picture").map((each) => [each.dataset.name, box(each)])),
      {
        outside: [...find(seen).filter((each) => isOutside(box(each))), ...find(inputs).filter(leavesPanel)].map(named),
        cut: find(texts).filter(isCut).map(named),
        low: find(`#drive > *, #messages, .tile .head, .tile .caption, ${panels}`).filter(isLow).map(named),
        scrolls: scrollWidth > innerWidth + 1 || scrollHeight > innerHeight + 1,
      },
    ];
  };
  // The page places its pictures in a ResizeObserver, between layout and paint. This observer runs after that one;
  // at any other time the layout may be one that is never painted, for example just after a banner appears.
  return new Promise((done) => {
    new ResizeObserver((_, self) => (self.disconnect(), done(measured()))).observe(document.documentElement);
  });
}"""


def boxes(page):
    """The box of each camera's picture; and elements outside the window, text cut off, whether the page scrolls."""
    return page.evaluate(BOXES)


def overlap(a, b):
    """Whether two boxes do, by more than a pixel."""
    return all(a[at] < b[at] + b[of] - 1 and b[at] < a[at] + a[of] - 1 for at, of in (("x", "width"), ("y", "height")))


AXE = rig.CHECKOUT / "node_modules" / "axe-core" / "axe.min.js"
needs_axe = pytest.mark.skipif(not AXE.exists(), reason="needs axe-core: npm ci")
SERIOUS = """async () => {
  const { violations } = await axe.run(document);
  const serious = violations.filter(({ impact }) => ["serious", "critical"].includes(impact));
  return serious.flatMap(({ id, help, nodes }) => nodes.map(({ html }) => `${id}: ${help}: ${html.slice(0, 150)}`));
}"""


def barriers(page):
    """What axe-core finds on a page that keeps people with a disability from using it."""
    if not page.evaluate("'axe' in globalThis"):
        page.evaluate(f"() => {{ {AXE.read_text()} }}")  # the page itself may load no other script
    return page.evaluate(SERIOUS)


SCREENS = ((1280, 720), (1920, 1080), (2560, 1440), (3840, 2160), (1024, 768))


def sized(page, width, height):
    page.set_viewport_size({"width": width, "height": height})
    until(lambda: page.evaluate("[innerWidth, innerHeight]") == [width, height])


def shot(page, name, **options):
    """Keep a picture of the page for people to look at, if TOD_SCREENSHOTS is set."""
    if SCREENSHOTS:
        page.screenshot(path=Path(SCREENSHOTS) / f"{name}.png", **options)


def send(page, **event):
    """Send a request as the page does; returns the reply."""
    return page.evaluate("event => tod.request(event)", event)


def viewing(page, view):
    """Choose a view by its key."""
    if page.evaluate("tod.view") != view:
        page.locator("body").press("v")
    assert page.evaluate("tod.view") == view


# Simulated gamepads.
PADS = """() => {
  globalThis.pads = [];
  globalThis.vibrations = [];
  globalThis.polls = 0;
  Object.defineProperty(navigator, "getGamepads", { value: () => (polls++, [...pads, null]) });
  globalThis.plug = (name) => {
    const buttons = Array.from({ length: 17 }, () => ({ pressed: false }));
    const axes = [0, 0];
    const vibrationActuator = { playEffect: async (kind, { duration }) => vibrations.push([kind, duration]) };
    pads.push({ index: 0, id: `${name} (Vendor: 046d)`, connected: true, buttons, axes, vibrationActuator });
    dispatchEvent(Object.assign(new Event("gamepadconnected"), { gamepad: pads[0] }));
  };
  globalThis.unplug = () => dispatchEvent(Object.assign(new Event("gamepaddisconnected"), { gamepad: pads.pop() }));
}"""


def press_button(page, button):
    """Press a button of the first pad until the page has polled it, and release it likewise."""
    for pressed in ("true", "false"):
        polls = page.evaluate(f"pads[0].buttons[{button}].pressed = {pressed}, polls")
        until(lambda polls=polls: page.evaluate("polls") >= polls + 2)
