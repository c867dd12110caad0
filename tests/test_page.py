"""The page of rival maps: its content against the maps, its server's refusals, and itself in a browser, where chromium and selenium are there."""

from __future__ import annotations

import gzip
import http.client
import json
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ssh_abduction import DState, Listing, MapError, Solution, SSHMap, Theory, Trace, solve, view_page
from ssh_abduction.cli import main
from ssh_abduction.maps import Path as MapPath
from ssh_abduction.rivals.page.content import content_of
from ssh_abduction.rivals.page.server import PageServer

EXAMPLES = Path(__file__).parent.parent / "examples"
ROUTE = EXAMPLES / "aces3-route.jsonl"
EVIL = "<script>alert(1)</script>"


@pytest.fixture(scope="module")
def route() -> Trace:
    return Trace.load(ROUTE)


@pytest.fixture(scope="module")
def rivals(route: Trace) -> Solution:
    return solve(route)


def test_overview_counts_the_maps_that_have_each_place(route: Trace, rivals: Solution) -> None:
    overview = content_of(rivals, route)["overview"]
    told = {tuple(node["steps"]): node["maps"] for node in overview["nodes"]}
    counted: dict[tuple[int, ...], int] = {}
    for ssh_map in rivals:
        at = [ssh_map.place_of(t) for t in range(len(route))]
        for place in set(at):
            steps = tuple(t for t, other in enumerate(at) if other == place)
            counted[steps] = counted.get(steps, 0) + 1
    assert told == counted
    assert min(told.values()) < max(told.values()) == len(rivals) == 4


def test_page_is_one_file_that_loads_nothing_and_keeps_texts_as_texts() -> None:
    trace = Trace.from_steps(views=[EVIL, "</script><b>", EVIL], actions=["travel", "around"])
    html = view_page(solve(trace), trace).html
    assert EVIL not in html
    assert "<b>" not in html
    assert html.count("<script") == html.count("</script>") == 2
    assert "default-src 'none'" in html
    assert "http://" not in html.replace("http://www.w3.org/2000/svg", "")
    assert "https://" not in html


def test_page_of_many_maps_of_500_dstates_is_small() -> None:
    places, maps = 250, []
    for k in range(150):
        dstates = tuple(DState(i, f"v{i % 40}", i // 2, (i // 2 + k * (i > 480)) % 7, 1 if i % 2 else -1) for i in range(2 * places))
        paths = tuple(MapPath(h, tuple(p for p in range(places) if p % 7 == h)) for h in range(7))
        maps.append(
            SSHMap(tuple(range(500)), dstates, tuple((i, "on", i + 1) for i in range(499)), tuple(range(places)), paths).renumbered()
        )
    assert len(gzip.compress(view_page(maps).html.encode())) < 250_000


def test_trace_of_other_maps_is_refused(rivals: Solution, route: Trace) -> None:
    with pytest.raises(MapError, match="expected 5, one for each step"):
        view_page(rivals, route[:5])


def test_view_writes_a_page(tmp_path: Path, rivals: Solution, capsys: pytest.CaptureFixture[str]) -> None:
    rivals.save(tmp_path / "maps.json")
    assert main(["view", str(tmp_path / "maps.json"), "-o", str(tmp_path / "page.html")]) == 0
    assert (tmp_path / "page.html").read_text().startswith("<!doctype html>")
    assert main(["view", str(tmp_path / "maps.json"), "--serve"]) == 1
    assert "expected the trace that was mapped" in capsys.readouterr().err


@pytest.fixture
def server(rivals: Solution, route: Trace) -> Iterator[PageServer]:
    with PageServer(Listing.of(rivals), route, rivals.theory) as served:
        thread = threading.Thread(target=served.serve_forever, args=(0.05,))
        thread.start()
        yield served
        served.shutdown()
        thread.join()


def asked(server: PageServer, method: str, path: str, body: Any = None, **headers: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
    text = None if body is None else json.dumps(body)
    connection.request(method, path, text, {"Content-Type": "application/json", **headers})
    answer = connection.getresponse()
    told = answer.status, answer.read()
    connection.close()
    return told


def test_server_answers_only_who_knows_its_token_from_this_computer(server: PageServer) -> None:
    own = server.url.partition(str(server.port))[2]
    assert asked(server, "GET", own)[0] == 200
    assert asked(server, "GET", "/") == (403, b"")
    assert asked(server, "GET", own[:-3] + "xx/") == (403, b"")
    assert asked(server, "GET", own, Host="evil.example") == (403, b"")
    assert asked(server, "POST", own + "solve", {}, Origin="http://evil.example") == (403, b"")
    assert asked(server, "POST", "/solve", {}) == (403, b"")


def test_server_solves_under_what_is_assumed_and_explains(server: PageServer, route: Trace) -> None:
    own = server.url.partition(str(server.port))[2]
    told = json.loads(asked(server, "POST", own + "solve", {"different": [[0, 9]]})[1])
    assert told["text"] == solve(route, Theory.topological().replace(different=((0, 9),)), maps=100).headline
    assert not any(entry["labels"][0] == entry["labels"][9] for entry in told["content"]["labelings"])
    why = json.loads(asked(server, "POST", own + "explain", {"pair": [0, 2]})[1])
    assert "steps 0 and 2 are different dstates" in why["text"]
    wrong = json.loads(asked(server, "POST", own + "explain", {"pair": [0, 99]})[1])
    assert "from 0 to 22" in wrong["error"]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    webdriver = pytest.importorskip("selenium.webdriver")
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if not chromium or not driver:
        pytest.skip("no chromium with its driver on this machine")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--window-size=1280,900"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    chrome = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    yield chrome
    chrome.quit()


class Shown:
    """The page in a browser."""

    def __init__(self, browser: Any, address: str) -> None:
        self.browser = browser
        browser.get(address)

    def __getitem__(self, name: str) -> Any:
        return self.browser.find_element("id", name)

    def click(self, name: str) -> None:
        self.browser.execute_script("document.getElementById(arguments[0]).click()", name)

    def choose(self, *steps: int) -> None:
        """Click the dstates of steps, as a pointer would."""
        for step in steps:
            self.browser.execute_script(
                "document.querySelector(`.dstate[data-step='${arguments[0]}']`).dispatchEvent(new MouseEvent('click', {bubbles: true}))",
                step,
            )

    def until(self, name: str, part: str) -> str:
        from selenium.webdriver.support.ui import WebDriverWait

        WebDriverWait(self.browser, 60).until(lambda _: part in self[name].text)
        return str(self[name].text)

    @property
    def complaints(self) -> list[str]:
        return [entry["message"] for entry in self.browser.get_log("browser") if "favicon" not in entry["message"]]


def test_page_in_the_browser(browser: Any, tmp_path: Path, rivals: Solution, route: Trace) -> None:
    file = tmp_path / "page.html"
    view_page(rivals, route).save(file)
    page = Shown(browser, file.as_uri())
    assert (
        page["sentence"].text
        == "4 minimal maps: the same dstates; the places of steps 15–18 and 21 differ; the paths of steps 18–22 differ"
    )
    page.click("one")
    page.click("paths")
    assert page["number"].get_attribute("value") == "2"
    assert not page["labels"].is_enabled()
    page.click("two")
    assert len(browser.find_elements("css selector", "figure")) == 2
    assert browser.find_elements("css selector", ".street.differs")
    browser.find_element("tag name", "body").send_keys("\ue014")  # the right arrow
    assert page["at"].text == "1 of 22"
    assert "in all maps" in page["rivals"].text
    page.click("one")
    page.choose(0, 2)
    assert page["verdict"].text.startswith("Steps 0 and 2: different dstates in every minimal map")
    page.click("same")
    assert page["answer"].text == "ssh-abduction solve TRACE --json --same 0,2 > maps.json"
    browser.set_window_size(500, 900)
    assert browser.execute_script("return document.documentElement.scrollWidth <= window.innerWidth")
    browser.set_window_size(1280, 900)
    assert page.complaints == []


def test_hostile_view_stays_text_in_the_browser(browser: Any, tmp_path: Path) -> None:
    trace = Trace.from_steps(views=[EVIL, "wall", EVIL], actions=["travel", "around"])
    view_page(solve(trace), trace).save(tmp_path / "page.html")
    page = Shown(browser, (tmp_path / "page.html").as_uri())
    assert EVIL in page["seen"].text  # an alert would have made this an error
    assert page.complaints == []


def test_assuming_and_explaining_in_the_browser(browser: Any, server: PageServer) -> None:
    page = Shown(browser, server.url)
    page.click("one")
    page.choose(0)
    page.browser.execute_script("const i = document.getElementById('later'); i.value = 9; i.dispatchEvent(new Event('change'))")
    page.click("why")
    page.until("answer", "one dstate in every minimal map")
    page.click("different")
    page.until("answer", "With steps 0 and 9 assumed different: optimal: 20 dstates")
    assert "--different 0,9" in page["sentence"].text
    page.click("forget")
    page.until("answer", "optimal: 19 dstates")
    assert page.complaints == []
