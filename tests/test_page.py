"""The page of rival maps: its content, its server, and itself in a browser, if there is one."""

from __future__ import annotations

import gzip
import http.client
import json
import re
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from itertools import combinations, product
from pathlib import Path
from typing import Any

import aces
import numpy as np
import pytest
from in_processes import until

from ssh_abduction import Localiser, Solution, SSHMap, Theory, Trace, solve, view_page
from ssh_abduction.cli import main
from ssh_abduction.cli.correct import correct_pair
from ssh_abduction.cli.use import write_frame
from ssh_abduction.data import Action, DState, MapError, Step, TraceError, together
from ssh_abduction.data.map_parts import Name
from ssh_abduction.data.maps import Fault, Fit, MapPath, Pose
from ssh_abduction.output.map_frames import MapFrame
from ssh_abduction.page import html
from ssh_abduction.page.content import ALPHABET, DRAWN, LOST, beams_of, content_of, drawn_images
from ssh_abduction.page.html import Page
from ssh_abduction.page.server import PageServer
from ssh_abduction.rivals import Listing
from ssh_abduction.runtime.limits import Watch
from ssh_abduction.runtime.workers import _under_way

EXAMPLES = Path(__file__).parent.parent / "examples"
ROUTE = EXAMPLES / "aces3-route.jsonl"
CORRIDOR = Trace.from_steps("abcbabcba", ["on"] * 8)  # to and fro, in four dstates
EVIL = "<script>alert(1)</script>"
HOSTILE = [EVIL, "</script><b>", '"onload="alert(1)', "\u2028-->", "<!--<script>"]


@pytest.fixture(scope="module")
def route() -> Trace:
    return Trace.load(ROUTE)


@pytest.fixture(scope="module")
def rivals() -> Solution:
    return aces.solution()


@pytest.fixture(scope="module")
def content(route: Trace, rivals: Solution) -> dict[str, Any]:
    return content_of(rivals, route)


@pytest.mark.slow
def test_overview_counts_the_maps_that_have_each_place(
    route: Trace, rivals: Solution, content: dict[str, Any]
) -> None:
    overview = content["overview"]
    told = {tuple(node["steps"]): node["maps"] for node in overview["nodes"]}
    counted: dict[tuple[int, ...], int] = {}
    for ssh_map in rivals:
        at = [ssh_map.place_of(t) for t in range(len(route))]
        for place in set(at):
            steps = tuple(t for t, other in enumerate(at) if other == place)
            counted[steps] = counted.get(steps, 0) + 1
    assert told == counted
    assert min(told.values()) < max(told.values()) == len(rivals) == 4
    driven = {tuple(sorted((t, t + 1))) for t in range(len(route) - 1)}
    for a, b, count, agreeing in overview["streets"]:
        here, there = (overview["nodes"][k]["steps"] for k in (a, b))
        assert any(
            tuple(sorted(pair)) in driven for pair in product(here, there)
        )  # the order of a path alone makes no street
        assert agreeing <= count <= 4


def hostile_page() -> Page:
    """The page of a trace whose texts all try to be HTML, with a fault and with beliefs."""
    trace = Trace.from_steps(views=[*HOSTILE, EVIL], actions=HOSTILE)
    trace = replace(trace, name=EVIL)
    solution = solve(trace, Theory.causal())
    faulty = replace(solution.maps[0], faults=(Fault(1, "misread", EVIL, "</script>", 1.0),))
    run = trace[:3]
    return view_page(
        replace(solution, maps=(faulty,)),
        trace,
        run=run,
        beliefs=lambda ssh_map: Localiser(ssh_map).beliefs(run),
    )


def test_page_is_one_file_that_loads_nothing_and_escapes_texts() -> None:
    text_of_page = hostile_page().html
    for text in [*HOSTILE, "<b>", "\u2028"]:
        assert text not in text_of_page
    assert text_of_page.count("<script") == text_of_page.count("</script>") == 2
    assert "default-src 'none'" in text_of_page
    assert "http://" not in text_of_page.replace("http://www.w3.org/2000/svg", "")
    assert "https://" not in text_of_page


def test_page_draws_ranges_at_the_bearings_of_the_header() -> None:
    images = [(1.0, float("inf"), 2.0, float("nan")), (4.0, 1.0, 2.0, 4.0)]
    steps = tuple(
        Step("v", image=image, action=Action("on") if k == 0 else None)
        for k, image in enumerate(images)
    )
    trace = Trace(steps, extra={"beams": {"first": -30, "step": 20}})
    drawn = drawn_images(trace)
    assert drawn is not None
    assert (drawn["first"], drawn["step"]) == (-30.0, 20.0)
    first = drawn["images"][0]
    assert first[1] == ALPHABET[-1]  # no echo came back: drawn to the limit
    assert first[3] == LOST
    assert ALPHABET.index(first[2]) == pytest.approx(2 * ALPHABET.index(first[0]), abs=1)
    assert [beams_of(Trace(steps), count) for count in (180, 181, 361)] == [
        (-89.5, 1.0),
        (-90.0, 1.0),
        (-90.0, 0.5),
    ]
    with pytest.raises(TraceError, match="go round once at most"):
        drawn_images(replace(trace, extra={"beams": {"first": 0, "step": 200}}))


def test_page_shows_ranges_of_a_sidecar_file_and_no_panoramas(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    np.savez(tmp_path / "images.npz", images=np.arange(12).reshape(2, 6) * 20)
    steps = (Step("a", Action("on"), image=1), Step("b", image=0))
    trace = Trace(steps, images="images.npz", source=str(tmp_path / "trace.jsonl"))
    drawn = drawn_images(trace)
    assert drawn is not None
    assert drawn["images"][1][0] == ALPHABET[0]
    assert drawn["images"][0][0] > drawn["images"][1][0]
    assert drawn_images(replace(trace, extra={"panorama": [2, 3, 1]})) is None
    monkeypatch.setattr("ssh_abduction.page.content.MOST", 1)
    with pytest.warns(UserWarning, match="2 images are more than a page holds"):
        assert drawn_images(trace) is None
    (tmp_path / "images.npz").unlink()
    with pytest.warns(UserWarning, match="the page is made without images"):
        assert drawn_images(trace) is None


def test_page_beliefs_equal_those_of_the_localiser() -> None:
    trace = Trace.from_steps("abcbabcb", ["on"] * 7)
    solution = solve(trace, Theory.causal())
    found = view_page(
        solution, trace, run=trace, beliefs=lambda ssh_map: Localiser(ssh_map).beliefs(trace)
    ).content
    (replayed,) = found["replays"]
    assert list(replayed["beliefs"]) == [
        str(number) for number in dict.fromkeys(told["labeling"] for told in found["maps"])
    ]
    for (verdict, nowhere, likely), belief in zip(
        replayed["beliefs"]["0"], Localiser(solution.maps[0]).beliefs(trace), strict=True
    ):
        assert verdict == belief.verdict.value
        assert nowhere == pytest.approx(belief.nowhere, abs=1e-3)
        assert likely[0] == [belief.likeliest, pytest.approx(belief.probability, abs=1e-3)]
    other = view_page(solution, trace, run=trace[2:6], beliefs=lambda ssh_map: None).content
    assert [len(one["steps"]) for one in other["replays"]] == [4, 8]
    with pytest.raises(MapError, match="expected 4, one for each step"):
        view_page(solution, trace, run=trace[2:6], beliefs=lambda ssh_map: [])


def test_page_colours_have_enough_contrast_for_the_colour_blind() -> None:
    light, dark = re.findall(
        r":root \{([^}]*)\}", (Path(html.__file__).parent / "page.css").read_text()
    )
    for theme in (light, dark):
        found = {name: linear(colour) for name, colour in re.findall(r"--(\w+): (#\w+)", theme)}
        bright = {
            name: float(colour @ [0.2126, 0.7152, 0.0722]) + 0.05 for name, colour in found.items()
        }
        drawn = [name for name in found if name not in ("paper", "panel", "rule")]
        assert (
            min(
                max(bright[name] / bright["paper"], bright["paper"] / bright[name])
                for name in drawn
            )
            > 3
        )
        assert max(bright["ink"] / bright["paper"], bright["paper"] / bright["ink"]) > 12
        for beside in (["few", "half", "most", "soft"], [f"path{k}" for k in range(6)]):
            for seen in DEFICIENT.values():
                labs = [cielab(np.array(seen) @ found[name]) for name in beside]
                assert min(np.linalg.norm(a - b) for a, b in combinations(labs, 2)) > 20


# How eyes see linear red, green and blue: with all cones, and without one kind of them (Machado,
# Oliveira & Fernandes 2009, severity 1).
DEFICIENT = {
    "none": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.01182, 0.04294, 0.968881],
    ],
}


def linear(colour: str) -> Any:
    digits = colour[1:] if len(colour) == 7 else "".join(2 * c for c in colour[1:])
    c = np.array([int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)])
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def cielab(rgb: Any) -> Any:
    to_xyz = np.array(
        [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    )
    x, y, z = np.cbrt(np.maximum(to_xyz @ np.clip(rgb, 0, 1) / [0.9505, 1, 1.089], 0.0005))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.slow
def test_page_of_many_large_maps_is_small() -> None:
    """A page has a limited number of drawings, each with its own poses. Further maps share them."""
    rng, places, maps = np.random.default_rng(0), 250, []
    for _ in range(DRAWN // 500 + 10):
        of_place = rng.integers(31, size=places).tolist()
        dstates = tuple(
            DState(i, f"v{i % 40}", i // 2, of_place[i // 2], 1 if i % 2 else -1)
            for i in range(2 * places)
        )
        paths = tuple(
            MapPath(h, tuple(p for p in range(places) if of_place[p] == h)) for h in range(31)
        )
        at = rng.normal(size=(500, 3)) + [[5 * (i // 2 % 16), 5 * (i // 32), 0] for i in range(500)]
        fit = Fit(
            1.0,
            1,
            0.5,
            poses=tuple(Pose(x, y, heading, (0.1, 0.02, 0.05)) for x, y, heading in at.tolist()),
        )
        maps.append(
            SSHMap(
                tuple(range(500)),
                dstates,
                tuple((i, "on", i + 1) for i in range(499)),
                tuple(range(places)),
                paths,
                fit=fit,
            )
        )
    found = view_page(maps)
    assert sum("layout" in told for told in found.content["maps"]) == DRAWN // 500
    assert len(found.content["layouts"][0]["ellipses"]) == places
    assert len(gzip.compress(found.html.encode())) < 250_000


def test_view_page_refuses_a_trace_of_other_maps(rivals: Solution, route: Trace) -> None:
    with pytest.raises(MapError, match="expected 5, one for each step"):
        view_page(rivals, route[:5])


def test_view_writes_a_page_with_beliefs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trace = Trace.from_steps("abcbabcb", ["on"] * 7)
    maps, run, page = (str(tmp_path / name) for name in ("maps.json", "it's.jsonl", "page.html"))
    solution = solve(trace, Theory.causal())
    solution.save(maps)
    trace.save(run)
    assert main(["localise", maps, run, "--json"]) == 0
    beliefs = json.loads(capsys.readouterr().out)["beliefs"]
    assert main(["view", maps, run, "--run", run, "-o", page]) == 0
    shown = shown_in(page)
    told = [[one["verdict"], round(one["nowhere"], 3)] for one in beliefs]
    assert [one[:2] for one in shown["replays"][0]["beliefs"]["0"]] == told
    assert shown["flags"] == f" --theory {maps}"
    assert shown["trace"] == f"'{tmp_path}/it'\"'\"'s.jsonl'"
    bare = tmp_path / "bare.json"
    bare.write_text(json.dumps(solution.to_dict()))
    assert main(["view", str(bare), "--serve", "--set", "open=false"]) == 1
    assert "expected the trace that was mapped" in capsys.readouterr().err


def shown_in(page: str) -> Any:
    return json.loads(
        Path(page)
        .read_text()
        .partition('<script type="application/json" id="content">')[2]
        .partition("</script>")[0]
    )


@pytest.fixture(scope="module")
def server() -> Iterator[PageServer]:
    with PageServer(
        Listing.of(solve(CORRIDOR, Theory.causal())), CORRIDOR, Theory.causal()
    ) as served:
        thread = threading.Thread(target=served.serve_forever, args=(0.05,))
        thread.start()
        yield served
        served.shutdown()
        thread.join()


def asked(
    server: PageServer, method: str, path: str, body: Any = None, **headers: str
) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=100)
    text = None if body is None else json.dumps(body)
    connection.request(method, path, text, {"Content-Type": "application/json", **headers})
    answer = connection.getresponse()
    told = answer.status, answer.read()
    connection.close()
    return told


def test_server_refuses_requests_without_token_or_from_elsewhere(server: PageServer) -> None:
    own = server.url.partition(str(server.port))[2]
    assert asked(server, "GET", own)[0] == 200
    assert asked(server, "GET", "/") == (403, b"")
    assert asked(server, "GET", own[:-3] + "xx/") == (403, b"")
    assert asked(server, "GET", own, Host="evil.example") == (403, b"")
    assert asked(server, "POST", own + "solve", {}, Origin="http://evil.example") == (403, b"")
    assert asked(server, "POST", "/solve", {}) == (403, b"")
    assert asked(server, "PUT", own, {}) == (403, b"")
    assert asked(server, "POST", own + "solve", {"same": "x" * 200_000}) == (403, b"")


@pytest.mark.parametrize(
    "length", ["9" * 5000, "-1", "", "+2", " ", "2.0", "0x2", "²", "٢", "2\r\nContent-Length: 3"]
)
def test_server_refuses_a_request_with_a_wrong_length(server: PageServer, length: str) -> None:
    own = server.url.partition(str(server.port))[2]
    with socket.create_connection(("127.0.0.1", server.port), timeout=20) as connection:
        head = (
            f"POST {own}solve HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n"
            f"Content-Type: application/json\r\nContent-Length: {length}\r\n\r\n{{}}"
        )
        connection.sendall(head.encode())
        assert connection.recv(100).startswith(b"HTTP/1.0 403")


def test_server_lets_many_connections_wait() -> None:
    """All connect at once, before the server takes the first one."""
    theory = Theory.causal()
    with (
        PageServer(Listing.of(solve(CORRIDOR, theory)), CORRIDOR, theory) as served,
        ExitStack() as clients,
    ):
        for _ in range(60):
            clients.enter_context(socket.create_connection(("127.0.0.1", served.port), timeout=5))


def test_server_stops_a_question_whose_client_is_gone(
    server: PageServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = server.url.partition(str(server.port))[2]
    monkeypatch.setattr("ssh_abduction.page.answers.solved_with", sleep)
    with socket.create_connection(("127.0.0.1", server.port)) as connection:
        connection.sendall(
            f"POST {own}solve HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n"
            f"Content-Type: application/json\r\nContent-Length: 2\r\n\r\n{{}}".encode()
        )
        until(lambda: bool(_under_way))
    until(lambda: not _under_way)
    assert b"expected a pair" in asked(server, "POST", own + "explain", {})[1]


@pytest.mark.slow
def test_server_starts_from_the_maps_of_the_page() -> None:
    """The time is too short for a search that would find these maps again."""
    trace = Trace.load(Path(__file__).parent.parent / "examples" / "aces3-route.jsonl")
    listing = Listing.of(solve(trace))
    with PageServer(listing, trace, time_limit=1e-3) as served:
        solved = served.answer("solve", {}, Watch(60))
        pair = served.answer("explain", {"pair": [0, 20]}, Watch(60))
        assumed = served.answer("explain", {"pair": [0, 20], "same": [[3, 9]]}, Watch(60))
    assert solved["text"].startswith("feasible (time limit): 19 dstates, 10 places, 4 paths")
    assert pair["text"].startswith("in map 1, the steps are at two places, place 0 and ")
    assert "\nit is unknown" in pair["text"]
    assert "no map is known that costs less: 19 dstates" in pair["assuming"]["different"]
    assert not assumed["text"].startswith("map 1")


def sleep(*arguments: object) -> None:
    time.sleep(60)


def test_server_solves_and_explains_under_assumptions(server: PageServer) -> None:
    own = server.url.partition(str(server.port))[2]
    told = json.loads(asked(server, "POST", own + "solve", {"different": [[0, 4]]})[1])
    assert (
        told["text"]
        == solve(CORRIDOR, Theory.causal().replace(different=((0, 4),)), max_maps=100).headline
    )
    assert not any(
        entry["labels"][0] == entry["labels"][4] for entry in told["content"]["labelings"]
    )
    why = json.loads(asked(server, "POST", own + "explain", {"pair": [0, 4]})[1])
    assert "steps 0 and 4 are one dstate in every minimal map" in why["text"]
    assert why["assuming"] == {"same": "costs nothing: 4 dstates", "different": "5 dstates, not 4"}
    wrong = json.loads(asked(server, "POST", own + "explain", {"pair": [0, 99]})[1])
    assert "from 0 to 8" in wrong["error"]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    webdriver = pytest.importorskip("selenium.webdriver")
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if not chromium or not driver:
        pytest.skip("no chromium with its driver on this machine")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-dev-shm-usage",
        "--disable-background-networking",
        "--window-size=1280,900",
    ):
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

    def drawn(self, selector: str) -> Any:
        return self.browser.find_element("css selector", selector)

    def click(self, name: str) -> None:
        self.browser.execute_script("document.getElementById(arguments[0]).click()", name)

    def choose(self, *steps: int) -> None:
        """Click the dstates of steps, as a pointer would."""
        for step in steps:
            self.browser.execute_script(
                "document.querySelector(`.dstate[data-step='${arguments[0]}']`)"
                ".dispatchEvent(new MouseEvent('click', {bubbles: true}))",
                step,
            )

    def until(self, name: str, part: str) -> str:
        from selenium.webdriver.support.ui import WebDriverWait

        WebDriverWait(self.browser, 60).until(lambda _: part in self[name].text)
        return str(self[name].text)

    @property
    def complaints(self) -> list[str]:
        return [
            entry["message"]
            for entry in self.browser.get_log("browser")
            if "favicon" not in entry["message"]
        ]


def test_page_in_the_browser(browser: Any, tmp_path: Path, content: dict[str, Any]) -> None:
    file = tmp_path / "page.html"
    Page(content).save(file)
    page = Shown(browser, file.as_uri())
    assert (
        page["sentence"].text
        == "4 minimal maps: the same dstates; the places of steps 15–18 and 21 differ; "
        "the paths of steps 18–22 differ"
    )
    assert browser.execute_script(
        "return figures[0].nodes.filter((node) => node.name).length === mapOf(0).places.size"
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
    assert page["joins"].text.split("\n") == [f"steps {a} and {b}" for a, b, _ in content["joins"]]
    page["joins"].find_element("tag name", "button").click()
    assert page["verdict"].text.startswith("Steps 0 and 9: one dstate in every minimal map")
    page.choose(0, 2)
    assert page["verdict"].text.startswith("Steps 0 and 2: different dstates in every minimal map")
    page.click("same")
    assert page["answer"].text.startswith(
        "ssh-abduction solve TRACE --json --same 0,2 > assumed.json\n"
        "ssh-abduction view assumed.json TRACE"
    )
    assert "more than the 19 dstates" in page["costs"].text
    browser.set_window_size(500, 900)
    assert browser.execute_script(
        "return document.documentElement.scrollWidth <= window.innerWidth"
    )
    browser.set_window_size(1280, 900)
    assert page.complaints == []


def test_browser_shows_hostile_texts_as_text(browser: Any, tmp_path: Path) -> None:
    hostile_page().save(tmp_path / "page.html")
    page = Shown(browser, (tmp_path / "page.html").as_uri())
    assert EVIL in page["seen"].text  # an alert would have made this an error
    assert EVIL in page["which"].get_attribute("textContent")
    browser.execute_script("chooseReplay(1); setStep(1); pick(0); pick(1)")
    assert EVIL in page["wrong"].text
    assert (
        browser.execute_script("return document.querySelectorAll('script, iframe, img, b').length")
        == 2
    )
    assert page.complaints == []


@pytest.mark.slow
def test_assuming_and_explaining_in_the_browser(browser: Any, server: PageServer) -> None:
    page = Shown(browser, server.url)
    page.choose(0, 1)
    page.until(
        "answer", "different dstates in every map"
    )  # the page asks as soon as two are chosen
    assert "no map satisfies the axioms" in page["costs"].text
    page.browser.execute_script(
        "for (const [id, t] of [['first', 0], ['later', 4]]) $(id).value = t;"
        "$('later').dispatchEvent(new Event('change'))"
    )
    page.click("different")  # the new question replaces the last one
    page.until("answer", "With steps 0 and 4 assumed different: optimal: 5 dstates")
    assert "--different 0,4" in page["sentence"].text
    page.click("forget")
    page.until("answer", "optimal: 4 dstates")
    page.browser.execute_script("why(); $('stop').click()")
    assert page["answer"].text == "Given up."
    assert page.complaints == []


def test_page_content_contains_regions(content: dict[str, Any], rivals: Solution) -> None:
    for told, ssh_map in zip(content["maps"], rivals.maps, strict=True):
        regions = content["regions"][told["regions"]]
        assert [(list(p), d) for p, _, d in regions] == [
            (list(r.places), r.door) for r in ssh_map.regions or ()
        ]
    blind = content_of([replace(rivals.maps[0], regions=None)])
    assert blind["regions"] == []
    assert "regions" not in blind["maps"][0]


def test_regions_in_the_browser(browser: Any, tmp_path: Path) -> None:
    trace = Trace.from_steps("abcdef", ["travel", "right", "travel", "left", "travel"])
    (tmp_path / "page.html").write_text(view_page(solve(trace), trace).html)
    page = Shown(browser, (tmp_path / "page.html").as_uri())
    told = page.browser.execute_script(
        "return [...document.querySelectorAll('#regions button')].map((b) => b.textContent)"
    )
    assert told == [
        "path 0 – right: 2",
        "path 1 – right: 0; left: 3",
        "path 2 – left: 1",
        "region 0: place 0, behind place 1",
        "region 3: place 3, behind place 2",
    ]
    script = "document.querySelectorAll('#regions button')[1].click()"
    page.browser.execute_script(script)
    count = "return ['.band', '.beside.right', '.beside.left'].map((c) => {0}.length)"
    rings = count.replace("{0}", "document.querySelectorAll('#drawings ' + c)")
    assert page.browser.execute_script(rings) == [2, 1, 1]
    page.browser.execute_script(script)
    assert page.browser.execute_script(rings) == [2, 0, 0]
    assert page.complaints == []


def test_page_names_floors_beside_their_places(browser: Any, tmp_path: Path) -> None:
    trace = Trace.from_steps("abcde", ["travel", Action("up", "lift"), "travel", "travel"])
    solution = solve(trace)
    content = content_of(solution, trace)
    (_, above), (_, below) = content["layouts"][0]["floors"]
    assert above > below
    Page(content).save(tmp_path / "page.html")
    page = Shown(browser, (tmp_path / "page.html").as_uri())
    page.click("one")
    names = browser.find_elements("css selector", "#drawings .name.floor")
    assert [name.text for name in names] == ["floor 0", "floor 1"]
    assert names[0].location["y"] < names[1].location["y"]
    assert [lift[-1] for lift in content["layouts"][0]["lifts"]] == ["up"]
    for figure in ("one", "overview"):
        page.click(figure)
        assert len(browser.find_elements("css selector", "#drawings .street.lift")) == 1
    assert page.complaints == []
    flat = solve(trace[:2])
    assert "floors" not in content_of(flat, trace[:2])["layouts"][0]
    tuesday = Trace.from_steps("de", ["travel"], name="tuesday")  # it took no lift
    joint = together([replace(trace, name="monday"), tuesday])
    Page(content_of(solve(joint), joint)).save(tmp_path / "joint.html")
    Shown(browser, (tmp_path / "joint.html").as_uri())
    assert len(browser.find_elements("css selector", "#drawings .trail:not(.lift)")) == 2
    assert len(browser.find_elements("css selector", "#drawings .trail.lift")) == 1


@pytest.mark.filterwarnings("ignore:views")  # the drives have no view in common
def test_page_draws_a_street_for_each_travel_without_paths(browser: Any, tmp_path: Path) -> None:
    """Maps of logs have places, but no paths. A lift and the start of a drive are no street."""
    monday = Trace.from_steps("abcde", ["travel", "travel", Action("up", "lift"), "travel"])
    trace = together([replace(monday, name="monday"), Trace.from_steps("fg", ["travel"], name="b")])
    (ssh_map, *_) = solve(trace).maps
    bare = replace(
        ssh_map,
        dstates=tuple(replace(s, path=None, direction=None) for s in ssh_map.dstates),
        paths=(),
        regions=None,
    )
    content = content_of(replace(bare, names=(Name("place", 1, "a long name"),)), trace)
    assert content["maps"][0]["leaps"] == [3, 5]
    at = [node["steps"] for node in content["overview"]["nodes"]]
    ends = {(at[a][0], at[b][0]) for a, b, _, _ in content["overview"]["streets"]}
    assert ends == {(0, 1), (1, 2), (3, 4)}  # b drives between the places of steps 0 and 1
    Page(content).save(tmp_path / "page.html")
    page = Shown(browser, (tmp_path / "page.html").as_uri())
    for figure in ("one", "overview"):
        page.click(figure)
        assert len(browser.find_elements("css selector", "#drawings .street:not(.lift)")) == 3
    page.click("one")
    own = browser.find_elements("css selector", "#drawings .name.own")
    assert [name.text for name in own] == ["a long name"]
    assert page.complaints == []


def test_page_of_a_joint_map_shows_its_drives(browser: Any, tmp_path: Path) -> None:
    monday = Trace.from_steps("abc", ["travel", "travel"], name="monday")
    tuesday = Trace.from_steps("cd", ["travel"], name="<b>tuesday</b>")
    joint = together([monday, tuesday])
    solution = solve(joint, Theory.causal())
    content = content_of(solution, joint)
    assert content["joined"] == "the map joins the 2 drives: monday, <b>tuesday</b>"
    assert [joined["joins"] for joined in content["between"]] == [[(2, 3, "all maps")]]
    Page(content).save(tmp_path / "page.html")
    page = Shown(browser, (tmp_path / "page.html").as_uri())
    assert page["joined"].text == content["joined"]
    # In one script, as the page may be drawn anew in between.
    trails = "return [...document.querySelectorAll('#drawings .trail')].map(e => e.classList.value)"
    assert len({*browser.execute_script(trails)}) == 2
    # A button leads to the first step of its drive, and playing ends with the drive.
    for k, (at, last) in enumerate([("monday:0 of 2", (0, 2)), ("<b>tuesday</b>:0 of 1", (3, 4))]):
        page["starts"].find_elements("tag name", "button")[k].click()
        assert page["at"].text.startswith(at)
        assert browser.execute_script("return endsOf(state.step)") == [*last]
    browser.execute_script("setStep(2)")
    assert page["seen"].text.endswith("this drive ends")
    page["between"].find_element("tag name", "button").click()
    assert page["verdict"].text.startswith("Steps monday:2 and <b>tuesday</b>:0: one dstate")
    values = "return [$('first').value, $('later').value]"
    assert browser.execute_script(values) == ["monday:2", "<b>tuesday</b>:0"]
    # A step is named by its drive in fields and in sentences.
    write = "$('later').value = arguments[0]; $('later').dispatchEvent(new Event('change'))"
    browser.execute_script(write, "<b>tuesday</b>:1")
    assert page["verdict"].text.startswith("Steps monday:2 and <b>tuesday</b>:1: different")
    browser.execute_script(write, "<b>tuesday</b>:2")
    said = "There is no step or place <b>tuesday</b>:2: steps are 0 to 4, a place is written as p4."
    assert page["verdict"].text == said
    browser.execute_script(write, "d1")
    assert browser.execute_script("return [...state.picked]") == [1, 2]
    told = browser.execute_script("return stretches([1, 2, 3, 4])")
    assert told == "steps monday:1–2, <b>tuesday</b>:0–1"
    assert page.complaints == []


def test_no_two_elements_of_the_page_have_one_id() -> None:
    template = (html.HERE / "page.html").read_text("utf-8")
    ids = re.findall(r'id="([^"]+)"', template)
    assert len(ids) == len(set(ids)) > 10


def test_server_writes_what_a_person_says_of_two_steps(
    house: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    maps = house / "maps.json"
    solution, trace = Solution.load(maps), Trace.load(house / "trace.jsonl")
    ground = html.ground_in(house / "page.html", len(trace))
    correct = partial(correct_pair, str(maps))
    with PageServer(Listing.of(solution), trace, ground=ground, correct=correct) as served:
        assert b'"corrects":true' in served.page
        watch = Watch(None)
        told = served.answer("correct", {"kind": "elsewhere", "pair": [0, 1]}, watch)["text"]
        assert "to obey: ssh-abduction solve" in told
        assert "elsewhere" in (house / "corrections.yaml").read_text()
        assert "made-before" in (house / "page.html").read_text()
        for wrong in ({"kind": "x", "pair": [0, 1]}, {"kind": "same", "pair": [0, 999]}):
            with pytest.raises(MapError, match="expected"):
                served.answer("correct", wrong, watch)
    with PageServer(Listing.of(solution), trace) as served:
        assert b'"corrects":false' in served.page
        with pytest.raises(MapError, match="expected explain or solve"):
            served.answer("correct", {"kind": "elsewhere", "pair": [0, 1]}, watch)


def test_server_writes_the_frame_of_two_points(house: Path) -> None:
    maps = str(house / "maps.json")
    solution, trace = Solution.load(maps), Trace.load(house / "trace.jsonl")
    with PageServer(Listing.of(solution), trace, frame=partial(write_frame, maps)) as served:
        watch, points = Watch(None), [[0, 0, 1, 1], [4, 0, 1, 6]]
        told = served.answer("frame", {"points": points}, watch)["text"]
        assert "at most 0.50 m" in told
        assert "1.250 times" in told
        assert "--frame-of" in told
        assert main(["export", maps, "--to", "nav2", "--frame-of", str(house / "frame.csv")]) == 0
        for wrong in ([[0, 0, 1, 1]], [[0, 0, 1]], [[0, 0, 1, None], [4, 0, 1, 6]], None):
            with pytest.raises(MapError, match="expected"):
                served.answer("frame", {"points": wrong}, watch)
        (house / "frame.csv").write_text("mine")
        with pytest.raises(MapError, match="another file; move it"):
            served.answer("frame", {"points": points}, watch)
        assert (house / "frame.csv").read_text() == "mine"
        (house / "frame.csv").unlink()


def test_view_refuses_a_used_port_and_other_folders(
    house: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["view", str(house), "--serve", "--set", f"port={port}"]) == 1
    assert f"port: expected a free port, got {port}" in capsys.readouterr().err
    other = tmp_path / "other"
    other.mkdir()
    (other / "page.html").write_text("mine")
    assert main(["view", str(other), "--serve"]) == 1
    assert "expected" in capsys.readouterr().err
    assert [path.name for path in other.iterdir()] == ["page.html"]
    assert (other / "page.html").read_text() == "mine"


def test_page_over_walls_in_the_browser(browser: Any, house: Path) -> None:
    from selenium.webdriver import ActionChains

    page = Shown(browser, (house / "page.html").as_uri())
    assert browser.find_elements("css selector", ".walls")
    assert browser.find_elements("css selector", ".ground .street")
    named = browser.execute_script("""
        const line = data.ground.way.slice(0, 40), room = { line, places: [0], bears: true };
        data.indoors = {
          corridors: [{ title: "corridor 0 (hall)", named: true, path: 0, line }],
          rooms: [{ ...room, title: "room 0" }, { ...room, title: "room 1 (shop)", named: true }],
        };
        paint();
        return [...document.querySelectorAll(".inroom")].map((label) => label.textContent);
    """)
    assert named == ["corridor 0 (hall)", "room 1 (shop)"]  # not room 0
    assert not browser.find_elements("css selector", "#drawings .dstate")  # off at first
    assert page.drawn(".laser").get_attribute("d") != ""
    page.click("layer-arrows")
    assert browser.find_elements("css selector", "#drawings .dstate")
    page["find"].send_keys("0\ue007")  # Enter
    assert page["found"].text == "place 0"
    assert browser.find_elements("css selector", ".found")
    browser.execute_script("pick(0); pick(3)")
    assert len(browser.find_elements("css selector", "#scans svg")) == 2
    page.click("reject")
    assert "ssh-abduction correct maps.json --elsewhere round:0,round:3" in page["answer"].text
    for text in ("d1", "round:1", "round:99"):
        page["find"].clear()
        page["find"].send_keys(f"{text}\ue007")
        known = "nothing is called round:99" if "99" in text else f"{text} at place 1"
        assert page["found"].text == known
    assert browser.find_elements("css selector", "#report details:not([open])")
    browser.execute_script("document.querySelector('#drawings svg').focus()")
    before = browser.execute_script("return camera.dx")
    browser.switch_to.active_element.send_keys("\ue014")  # the right arrow
    assert browser.execute_script("return camera.dx") == before - 60
    page["slider"].send_keys("\ue013")  # the arrow key moves to the next scan
    browser.execute_script("setScan(data.ground.at[1] - 1)")
    assert browser.execute_script("return state.step") == 0
    assert page.drawn(".laser").get_attribute("d") != ""
    browser.execute_script("document.querySelector('#framed details').open = true")
    for row in browser.find_elements("css selector", "#points fieldset"):
        row.find_element("css selector", "button").click()
        drawing = page.drawn("#drawings svg")
        y = {"1": 60, "2": -60}.get(row.text[6], 20)
        ActionChains(browser).move_to_element_with_offset(drawing, 0, y).click().perform()
        browser.switch_to.active_element.send_keys({60: "3\t4", -60: "3\t14"}.get(y, "5\t7"))
        page.click("frame")
    assert "printf 'map_x,map_y,x,y" in page["framing"].text
    assert len(browser.find_elements("css selector", ".point")) == 3
    points = [[0, 0, 1, 1], [4, 0, 1.2, 5], [1, 3, -2, 1.5]]
    off = browser.execute_script("return residuals(arguments[0])", points)
    named = {str(k): (complex(*point[:2]), complex(*point[2:])) for k, point in enumerate(points)}
    assert off == pytest.approx([far for _, far in MapFrame.of_points(named).residuals])
    assert page.complaints == []
