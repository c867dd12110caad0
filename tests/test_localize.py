"""Beliefs over dstates: against a plain Bayes filter, for kidnapped robots, and off the map."""

from __future__ import annotations

import io
import json
import math
import random
import sys
from collections.abc import Callable, Sequence
from dataclasses import FrozenInstanceError
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from instances import maze, moore
from sklearn.neighbors import KNeighborsClassifier
from worlds import rectangle

from perception.errors import ImageWarning, PerceptionError
from perception.recognition import ImageLikelihood, PlaceRecogniser, recogniser
from perception.store import save
from ssh_abduction import Localiser, SSHMap, Theory, Trace, solve
from ssh_abduction.cli import main
from ssh_abduction.data import Action, LocaliserError, MapError, Step, TraceError
from ssh_abduction.data.map_parts import DState, Fit, Pose
from ssh_abduction.online import Belief, Chances
from ssh_abduction.online.localiser import COLLAPSED, BeliefVerdict

Array = np.ndarray[Any, Any]


def map_of(
    views: Sequence[Any], links: Sequence[tuple[int, str, int]], labels: Sequence[int] = (0,)
) -> SSHMap:
    return SSHMap(
        tuple(labels), tuple(DState(i, view) for i, view in enumerate(views)), tuple(links)
    )


def true_map(truth: Sequence[object], trace: Trace) -> SSHMap:
    """The map that truth makes of a walk."""
    number: dict[object, int] = {}
    labels = [number.setdefault(x, len(number)) for x in truth]
    views = [trace.steps[labels.index(x)].view for x in range(len(number))]
    return map_of(
        views,
        sorted(
            {(x, a.name, y) for x, a, y in zip(labels, trace.actions, labels[1:], strict=False)}
        ),
        labels,
    )


def drive(
    ssh_map: SSHMap, steps: int, seed: int, kidnapped: int | None = None
) -> tuple[Trace, list[int]]:
    """A random walk along the links of a map, and where the robot is.

    At step `kidnapped` it is not where the link leads, but at a dstate that looks different.
    """
    chance = random.Random(seed)
    leads: dict[int, list[tuple[str, int]]] = {}
    for x, action, y in ssh_map.links:
        leads.setdefault(x, []).append((action, y))
    at, actions = [chance.choice(sorted(leads))], []
    for step in range(1, steps):
        action, there = chance.choice(leads[at[-1]])
        if step == kidnapped:
            there = chance.choice(
                [
                    s.id
                    for s in ssh_map.dstates
                    if s.id in leads and s.view != ssh_map.dstates[there].view
                ]
            )
        if there not in leads:
            break
        actions.append(action)
        at.append(there)
    return Trace.from_steps([ssh_map.dstates[x].view for x in at], actions), at


# a filter written out from the equations


def filtered(
    ssh_map: SSHMap, trace: Trace, chances: Chances, labelled: Trace | None = None
) -> list[tuple[Array, float]]:
    """Equations 1 to 4 as dense tables. The last two rows are the strange and the akin nowhere.

    Yields the belief after each step, and p(o) / q(o) by the belief before.
    """
    n = len(ssh_map.dstates)
    steps = range(0) if labelled is None else range(len(labelled))
    prior = np.array([(1 - chances.unmapped) / n] * n + [chances.unmapped / 2] * 2)

    def f_view(view: Any, x: int) -> float:
        visits = [
            t
            for t in steps
            if ssh_map.labels[t] == x and labelled and labelled.steps[t].view is not None
        ]
        if not visits:
            return float(ssh_map.dstates[x].view == view)
        return (
            sum(labelled.steps[t].view == view for t in visits) / len(visits) if labelled else 0.0
        )

    def f_action(y: int, x: int, action: str) -> float | None:
        if labelled:
            after = [
                ssh_map.labels[t + 1]
                for t in steps[:-1]
                if ssh_map.labels[t] == x and labelled.actions[t].name == action
            ]
            if after:
                return after.count(y) / len(after)
        ends = [there for here, name, there in set(ssh_map.links) if (here, name) == (x, action)]
        return ends.count(y) / len(ends) if ends else None

    def is_novel(view: Any) -> bool:
        return all(f_view(view, x) == 0 for x in range(n))

    def broad(view: Any) -> float:
        return (sum(f_view(view, x) for x in range(n)) + is_novel(view)) / (n + 1)

    def akin(before: Any, action: str | None, view: Any) -> float:
        if None in (before, action) or is_novel(view) or is_novel(before):
            return broad(view)
        alike = {x: f_view(before, x) for x in range(n) if f_action(0, x, str(action)) is not None}
        if not sum(alike.values()):
            return broad(view)
        number = sum(alike.values()) ** 2 / sum(w**2 for w in alike.values())
        mean = sum(
            w * sum((f_action(y, x, str(action)) or 0) * f_view(view, y) for y in range(n))
            for x, w in alike.items()
        ) / sum(alike.values())
        return (number * n / (n + 1) * mean + broad(view)) / (number + 1)

    def observed(before: Any, action: str | None, view: Any) -> Array:
        if view is None:
            return np.ones(n + 2)
        q = broad(view)
        return np.array(
            [(1 - chances.misread) * f_view(view, x) + chances.misread * q for x in range(n)]
            + [q, akin(before, action, view)]
        )

    def moved(action: str) -> Array:
        """x' by x."""
        table = np.zeros((n + 2, n + 2))
        for x in range(n):
            for y in range(n + 2):
                led = f_action(y, x, action)
                table[y, x] = (
                    prior[y]
                    if led is None
                    else (1 - chances.slipped) * led + chances.slipped * prior[y]
                )
        for nowhere in (n, n + 1):
            table[:n, nowhere] = chances.reentered / n
            table[nowhere, nowhere] = 1 - chances.reentered
        return table

    found = []
    belief, before = prior, None
    for t, step in enumerate(trace):
        action = trace.actions[t - 1].name if t else None
        expected = moved(action) @ belief if action else prior
        joint = observed(before, action, step.view) * expected
        p = joint.sum() / broad(step.view) if step.view is not None else joint.sum()
        if not joint.sum():
            joint = observed(before, action, step.view) * prior
        if not joint.sum():
            joint = np.array([0] * n + [0.5, 0.5])
        belief, before = joint / joint.sum(), step.view
        found.append((np.array([*belief[:n], belief[n:].sum()]), float(p)))
    return found


def assert_as_filtered(localiser: Localiser, trace: Trace, labelled: Trace | None = None) -> None:
    beliefs = list(localiser.beliefs(trace))
    expected = filtered(localiser.ssh_map, trace, localiser.chances, labelled)
    assert len(beliefs) == len(trace)
    for belief, (probabilities, normaliser) in zip(beliefs, expected, strict=True):
        assert belief.probabilities == pytest.approx(probabilities[:-1], abs=1e-12)
        assert belief.nowhere == pytest.approx(probabilities[-1], abs=1e-12)
        assert belief.normaliser == pytest.approx(normaliser, rel=1e-9, abs=1e-12)
        certain = probabilities[probabilities > 0]
        assert belief.entropy == pytest.approx(-(certain * np.log2(certain)).sum(), abs=1e-9)


def random_case(seed: int) -> tuple[SSHMap, Trace, Trace]:
    """A map, a trace that partly contradicts it, and another trace that is partly unknown to it."""
    chance = random.Random(seed)
    n = chance.randint(1, 5)
    views = [chance.choice("abc") for _ in range(n)]
    links = {
        (x, chance.choice("st")): chance.randrange(n)
        for x in range(n)
        for _ in range(chance.randint(0, 2))
    }
    labels = [chance.randrange(n) for _ in range(chance.randint(1, 12))]
    seen = [views[x] if chance.random() < 0.8 else chance.choice("abcd") for x in labels]
    labelled = Trace.from_steps(seen, [chance.choice("st") for _ in labels[1:]])
    other = [
        Step(chance.choice(["a", "b", "c", "d", None]), None) for _ in range(chance.randint(1, 8))
    ]
    done = Trace.from_steps("a" * len(other), [chance.choice("stu") for _ in other[1:]])
    trace = Trace(
        tuple(
            Step(s.view or (None if i else "a"), d.action)
            for i, (s, d) in enumerate(zip(other, done, strict=True))
        )
    )
    return (
        map_of(views, [(x, action, y) for (x, action), y in links.items()], labels),
        labelled,
        trace,
    )


@pytest.mark.parametrize("seed", range(60))
def test_beliefs_equal_a_filter_written_from_the_equations(seed: int) -> None:
    ssh_map, labelled, trace = random_case(seed)
    chance = random.Random(seed)
    chances = chance.choice(
        [Chances(), Chances.none(), Chances(*(chance.random() for _ in range(4)))]
    )
    assert_as_filtered(Localiser(ssh_map, chances=chances), trace)
    assert_as_filtered(Localiser(ssh_map, trace=labelled, chances=chances), trace, labelled)


@pytest.mark.parametrize("seed", range(4))
def test_beliefs_by_map_equal_beliefs_by_its_trace(seed: int) -> None:
    """On the trace that a map explains, equation 3 is equation 4, to the last bit.

    The beliefs are also those of a filter that counts only what is allowed.
    """
    walk = moore(9, 3, steps=300, seed=seed) if seed % 2 else maze(3, 3, steps=300, seed=seed)
    ssh_map = true_map(walk.truth, walk.trace)
    other, at = drive(ssh_map, 40, seed)
    by_map = list(Localiser(ssh_map, chances=Chances.none()).beliefs(other))
    by_trace = list(Localiser(ssh_map, trace=walk.trace, chances=Chances.none()).beliefs(other))
    leads = {(x, action): y for x, action, y in ssh_map.links}
    weight = {s.id: 1.0 for s in ssh_map.dstates}
    for t, (one, two) in enumerate(zip(by_map, by_trace, strict=True)):
        assert (one.probabilities == two.probabilities).all()
        if t:
            moved: dict[int, float] = {}
            for x, w in weight.items():
                # An action without a link may lead anywhere.
                ends = (
                    [leads[x, other.actions[t - 1].name]]
                    if (x, other.actions[t - 1].name) in leads
                    else range(len(ssh_map.dstates))
                )
                for y in ends:
                    moved[y] = moved.get(y, 0) + w / len(ends)
            weight = moved
        weight = {x: w for x, w in weight.items() if ssh_map.dstates[x].view == other.steps[t].view}
        weight = {x: w / sum(weight.values()) for x, w in weight.items()}
        assert dict(one.above(1e-300)) == pytest.approx(weight)
        assert at[t] in weight


def test_localiser_counts_views_and_links_of_a_labelled_trace() -> None:
    """Dstate 0 showed `a` in three of four visits, and `on` led from it to 1 in two of three."""
    ssh_map = map_of("ab", [(0, "on", 1)], [0, 1, 0, 1, 0, 0])
    labelled = Trace.from_steps("abcbaa", ["on", "back", "on", "back", "on"])
    localiser = Localiser(ssh_map, trace=labelled, chances=Chances.none())
    assert localiser.start("c").probabilities.tolist() == [1, 0]
    assert localiser.update(localiser.start("c"), "on").probabilities == pytest.approx(
        [1 / 3, 2 / 3]
    )
    both = localiser.update(localiser.start("c"), "on", "a")
    assert both.probabilities.tolist() == [1, 0]
    assert both.normaliser == pytest.approx(3 / 4 * 1 / 3 / ((3 / 4) / 3))


# kidnapped, and nowhere


@pytest.mark.parametrize("seed", range(8))
def test_localiser_notices_and_finds_a_kidnapped_robot(seed: int) -> None:
    walk = moore(20, 6, steps=800, seed=100 + seed)
    ssh_map = true_map(walk.truth, walk.trace)
    trace, at = drive(ssh_map, 60, seed, kidnapped=30)
    beliefs = list(Localiser(ssh_map).beliefs(trace))
    assert [b.dstate for b in beliefs[10:30]] == at[10:30]
    assert not any(b.collapsed or b.lost for b in beliefs[:30])
    assert beliefs[30].collapsed
    assert beliefs[30].lost
    assert beliefs[30].normaliser < COLLAPSED < 1 < min(b.normaliser for b in beliefs[5:30])
    assert [b.dstate for b in beliefs[42:]] == at[42:]
    assert {b.verdict for b in beliefs[42:]} == {BeliefVerdict.LOCATED}
    assert not beliefs[-1].lost


def test_localiser_tolerates_one_misread_view() -> None:
    walk = moore(20, 6, steps=800, seed=5)
    ssh_map = true_map(walk.truth, walk.trace)
    trace, at = drive(ssh_map, 40, 1)
    views = [*trace.views]
    views[20] = next(v for v in sorted(set(views), key=str) if v != views[20])
    beliefs = list(Localiser(ssh_map).beliefs(trace.with_views(views)))
    assert beliefs[20].collapsed
    assert [b.dstate for b in beliefs[25:]] == at[25:]
    assert beliefs[25].verdict is BeliefVerdict.LOCATED


def test_lost_robot_is_found_if_as_sure_as_before() -> None:
    """Opposite corners of the notched rectangle look alike, and so do the dstates after them."""
    (ssh_map,) = solve(rectangle(40), Theory.topological()).maps
    views = [f"v{i % 4}" for i in range(9)] + [f"v{i % 4}" for i in range(3, 10)]
    trace = Trace.from_steps(views, [["right", "travel"][int(v[1]) % 2] for v in views[:-1]])
    beliefs = list(Localiser(ssh_map).beliefs(trace))
    assert dict(beliefs[8].above(0.4)) == pytest.approx({0: 0.5, 4: 0.5}, abs=0.01)
    assert beliefs[8].entropy == pytest.approx(1, abs=0.05)
    assert {b.verdict for b in beliefs[:9]} == {BeliefVerdict.UNSURE}
    assert (beliefs[9].verdict, beliefs[9].entropy > 2) == (BeliefVerdict.LOST, True)
    assert (beliefs[-1].verdict, beliefs[-1].lost) == (BeliefVerdict.UNSURE, False)


def test_unknown_views_give_the_belief_nowhere() -> None:
    ssh_map = true_map(*_walk_of_moore(3))
    trace, at = drive(ssh_map, 24, 3)
    views = [v if t < 12 or t >= 16 else "a lift" for t, v in enumerate(trace.views)]
    beliefs = list(Localiser(ssh_map).beliefs(trace.with_views(views)))
    assert beliefs[12].collapsed
    assert [b.verdict for b in beliefs[13:16]] == [BeliefVerdict.NOWHERE] * 3
    assert [b.dstate for b in beliefs[13:16]] == [None] * 3
    assert beliefs[-1].dstate == at[-1]
    assert Localiser(ssh_map).start("a lift").dstate is None
    without = list(Localiser(ssh_map, chances=Chances.none()).beliefs(trace.with_views(views)))
    assert [b.nowhere for b in without[12:16]] == [1.0] * 4
    assert [b.dstate for b in without[20:]] == at[20:]


@pytest.mark.parametrize("seed", range(5))
def test_another_world_with_equal_views_gives_the_belief_nowhere(seed: int) -> None:
    """No view is new there, but their order differs from the map."""
    ssh_map, foreign = true_map(*_walk_of_moore(seed)), true_map(*_walk_of_moore(50 + seed))
    trace, _ = drive(foreign, 60, seed)
    verdicts = [b.verdict for b in Localiser(ssh_map).beliefs(trace)][20:]
    assert verdicts.count(BeliefVerdict.NOWHERE) > 0.6 * len(verdicts)
    own, _ = drive(ssh_map, 60, seed)
    assert BeliefVerdict.NOWHERE not in [b.verdict for b in Localiser(ssh_map).beliefs(own)]


def _walk_of_moore(seed: int) -> tuple[Sequence[object], Trace]:
    walk = moore(12, 4, steps=400, seed=seed)
    return walk.truth, walk.trace


# beliefs as values


@pytest.mark.parametrize(("degrees", "expected"), [(93.0, 2), (-86.0, 1), (180.0, None)])
def test_localiser_compares_turns_by_angle(degrees: float, expected: int | None) -> None:
    """Both sides of a hall have a door. No two drives have turns with the same names."""
    ssh_map = SSHMap(
        (0, 1, 0, 2),
        tuple(DState(i, view, place=0) for i, view in enumerate(["hall", "door", "door"])),
        ((0, "turn 270.5", 1), (0, "turn 88.7", 2)),
        fit=Fit(0.0, 1, 1.0, poses=tuple(Pose(0.0, 0.0, a) for a in (0.0, 1.6, -1.5))),
    )
    turn = Action(f"turn {degrees:g}", "turn", "right")
    other = Trace.from_steps(
        ["hall", "door"], [turn], displacements=[(0.0, 0.0, -math.radians(degrees))]
    )
    localiser = Localiser(ssh_map)
    *_, belief = localiser.beliefs(other)
    assert belief.dstate == expected if expected else belief.probabilities[1:].max() < 0.6
    if expected:
        turned = Action(turn.name, "turn", bearing=degrees)
        assert localiser.update(localiser.start("hall"), turned, "door").dstate == expected


def test_belief_is_frozen_and_has_verdict_and_entropy() -> None:
    localiser = Localiser(map_of("aab", [(0, "on", 2), (1, "on", 1), (2, "on", 0)]))
    prior, belief = localiser.prior, localiser.start("a")
    assert prior.probabilities.sum() + prior.nowhere == pytest.approx(1)
    assert prior.entropy == pytest.approx(-(0.9 * math.log2(0.3) + 0.1 * math.log2(0.1)))
    assert (belief.verdict, belief.likeliest, belief.dstate) == (BeliefVerdict.UNSURE, 0, 0)
    with pytest.raises(ValueError, match="read-only"):
        belief.probabilities[0] = 1
    with pytest.raises(FrozenInstanceError):
        belief.nowhere = 1  # type: ignore[misc]
    assert localiser.update(belief, "on").normaliser == pytest.approx(1)
    assert repr(belief).startswith("<Belief unsure: dstate 0 with probability 0.4")
    assert "3 dstates" in repr(localiser)
    told = json.loads(json.dumps(localiser.update(belief, "on", "b").to_dict()))
    assert told["dstate"] == told["probabilities"][0][0] == 2
    assert told["verdict"] == "located"
    assert '"collapsed": true' in json.dumps(Belief(np.ones(1), 0.0, np.float64(0.01)).to_dict())
    nowhere = Belief(np.zeros(2), 1.0)
    assert (nowhere.entropy, nowhere.dstate, nowhere.verdict) == (0, None, BeliefVerdict.NOWHERE)


def test_probabilities_sum_to_one_over_a_long_run() -> None:
    ssh_map = true_map(*_walk_of_moore(1))
    trace, _ = drive(ssh_map, 3000, 1)
    *_, last = Localiser(ssh_map).beliefs(trace)
    assert last.probabilities.sum() + last.nowhere == pytest.approx(1, abs=1e-12)


# images


def pictures(
    dstates: int, each: int, seed: int, beams: int = 12, noise: float = 0.03
) -> tuple[Array, Array]:
    """Ranges as noisy images of places, and their places."""
    places = np.random.default_rng(7).uniform(0.5, 6, (dstates, beams))
    at = np.tile(np.arange(dstates), each)
    return places[at] * np.random.default_rng(seed).normal(1, noise, (len(at), beams)), at


def test_foreign_image_gets_no_label() -> None:
    images, at = pictures(6, 8, seed=1)
    known = recogniser().fit(images, at)
    likelihood = ImageLikelihood.of(known)
    more, truth = pictures(6, 20, seed=2)
    assert np.mean(np.array(likelihood.labels(more)) == truth) > 0.98
    rng = np.random.default_rng(3)
    nothing = [np.full(12, 30.0), np.full(12, 0.06), *rng.uniform(0.5, 6, (10, 12))]
    assert likelihood.labels(nothing) == [None] * 12
    assert None not in known.predict(nothing).tolist()
    assert likelihood.labels(more, unmapped=0.0) == known.predict(more).tolist()


def test_image_density_is_a_gaussian_about_the_nearest_image() -> None:
    images, at = pictures(3, 5, seed=1, beams=4)
    likelihood = ImageLikelihood.of(PlaceRecogniser().fit(images, at))
    squares = [
        min(float(((a - b) ** 2).sum()) for j, b in enumerate(images) if at[j] == at[i] and j != i)
        for i, a in enumerate(images)
    ]
    mean, k = np.mean(squares), 2 * np.mean(squares) ** 2 / np.var(squares)
    k = min(max(k, 1), 4)
    assert (likelihood.within, likelihood.dimensions) == pytest.approx((mean, k))
    image = images[0] + 0.02

    def density(square: float, variance: float) -> float:
        return math.exp(-square / (2 * variance)) * (2 * math.pi * variance) ** (-k / 2)

    places = [
        density(min(((image - b) ** 2).sum() for b in images[at == x]), mean / k) for x in range(3)
    ]
    centre = images.mean(axis=0)
    novel = density(
        ((image - centre) ** 2).sum(), np.mean(((images - centre) ** 2).sum(axis=1)) / k
    )
    (ratios,) = likelihood.ratios([image])
    assert ratios == pytest.approx(np.array(places) * 4 / (sum(places) + novel))


def test_one_image_a_place_gives_a_weak_but_correct_likelihood() -> None:
    images, at = pictures(6, 2, seed=1)
    with pytest.warns(ImageWarning, match="Each place has one image"):
        likelihood = ImageLikelihood.of(recogniser().fit(images[:6], at[:6]))
    surer = ImageLikelihood.of(recogniser().fit(images, at))
    more, truth = pictures(6, 5, seed=2)
    for image, place in zip(more, truth, strict=True):
        (ratios,), (more_sure,) = likelihood.ratios([image]), surer.ratios([image])
        assert ratios.argmax() == place
        assert 1 < ratios[place] < more_sure[place]


def test_localiser_reads_images() -> None:
    """Two of the six places look the same; what follows tells them apart.

    In the middle somebody stands in front, and then the robot is carried elsewhere.
    """
    images, at = pictures(5, 8, seed=1)
    ring = map_of(["v"] * 6, [(i, "on", (i + 1) % 6) for i in range(6)])
    looks = [0, 1, 2, 3, 4, 2]
    learnt, labels = (
        np.concatenate([images, images[at == 2]]),
        np.concatenate([at, np.full((at == 2).sum(), 5)]),
    )
    localiser = Localiser(ring, recogniser().fit(learnt, labels))
    route = [5, 0, 1, 2, 3, 4, 5, 0, 1, 4, 5, 0, 1]  # carried from 1 to 4 at step 9
    fresh, places = pictures(5, 4, seed=9)
    shown = [fresh[np.flatnonzero(places == looks[x])[t % 4]] for t, x in enumerate(route)]
    shown[4] = np.full(12, 0.4)
    beliefs = list(localiser.beliefs(_imaged(shown)))
    assert {x for x, _ in beliefs[0].above(0.3)} == {2, 5}
    assert [b.dstate for b in beliefs[1:4]] == [0, 1, 2]
    assert beliefs[4].collapsed
    assert [b.dstate for b in beliefs[5:9]] == [4, 5, 0, 1]
    assert beliefs[9].collapsed
    assert [b.dstate for b in beliefs[9:]] == [4, 5, 0, 1]
    stepwise = localiser.start(image=shown[0])
    assert stepwise.probabilities == pytest.approx(beliefs[0].probabilities)
    assert localiser.update(stepwise, "on", image=shown[1]).probabilities == pytest.approx(
        beliefs[1].probabilities
    )
    lost = list(localiser.beliefs(_imaged([np.full(12, 0.3 + t) for t in range(4)])))
    assert [b.dstate for b in lost] == [None] * 4


def _imaged(images: Sequence[Array]) -> Trace:
    actions = Trace.from_steps("v" * len(images), ["on"] * (len(images) - 1)).steps
    return Trace(
        tuple(
            Step(image=tuple(map(float, image)), action=step.action)
            for image, step in zip(images, actions, strict=True)
        )
    )


def test_image_leaves_a_dstate_without_images_unchanged() -> None:
    images, at = pictures(2, 8, seed=1)
    localiser = Localiser(
        map_of("vvv", []), recogniser().fit(images, at), chances=Chances(unmapped=0.1)
    )
    belief = localiser.start(image=np.full(12, 40.0))
    assert belief.probabilities[2] / belief.nowhere == pytest.approx(0.3 / 0.1)
    assert localiser.start(image=images[0]).likeliest == 0


# bad input


RING = map_of("abc", [(0, "on", 1), (1, "on", 2), (2, "on", 0)], [0, 1, 2])
IMAGES, AT = pictures(3, 4, seed=1)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Localiser("map"), MapError, "expected an SSHMap, got 'map'"),  # type: ignore[arg-type]
        (
            lambda: Localiser(map_of("", [])),
            MapError,
            r"dstates: expected the ids 0, 1, 2, …, got \[\]",
        ),
        (
            lambda: Localiser(map_of("ab", [(0, "on", 7)])),
            MapError,
            "expected dstates 0 to 1 in labels and links, got 7",
        ),
        (
            lambda: Localiser(RING, trace=rectangle(5)),
            MapError,
            "labels: expected 6, one for each step of the trace, got 3",
        ),
        (lambda: Localiser(RING, trace="t"), TraceError, "expected a Trace, got 't'"),  # type: ignore[arg-type]
        (
            lambda: Localiser(RING, chances=0.1),
            LocaliserError,
            "chances: expected Chances, got 0.1",
        ),  # type: ignore[arg-type]
        (
            lambda: Chances(misread=1.5),
            LocaliserError,
            "misread: expected a probability from 0 to 1, got 1.5",
        ),
        (
            lambda: Chances(slipped=math.nan),
            LocaliserError,
            "slipped: expected a probability from 0 to 1, got nan",
        ),
        (lambda: Chances(unmapped="x"), LocaliserError, "unmapped: expected a probability"),  # type: ignore[arg-type]
        (
            lambda: Localiser(RING, KNeighborsClassifier()),
            PerceptionError,
            "expected a PlaceRecogniser, or a pipeline that ends with one",
        ),
        (
            lambda: Localiser(RING, recogniser().fit(IMAGES, AT + 1)),
            LocaliserError,
            "expected the dstates 0 to 2 of the map as labels",
        ),
        (
            lambda: Localiser(RING, recogniser().fit(IMAGES[:1], AT[:1])),
            PerceptionError,
            "expected two images or more",
        ),
        (
            lambda: Localiser(RING, PlaceRecogniser().fit(1e200 * IMAGES, AT)),
            PerceptionError,
            "numbers too large to square",
        ),
        (
            lambda: Localiser(RING, recogniser()),
            PerceptionError,
            "expected a fitted one, got a new one",
        ),
        (
            lambda: list(Localiser(RING).beliefs(_imaged(IMAGES))),
            TraceError,
            "view: expected the views of the map, got images only",
        ),
        (lambda: list(Localiser(RING).beliefs("t")), TraceError, "expected a Trace"),  # type: ignore[arg-type]
        (
            lambda: Localiser(RING).start(image=IMAGES[0]),
            LocaliserError,
            "expected a view, as the localiser has no recogniser",
        ),
        (
            lambda: Localiser(RING).start(view=1.5),
            TraceError,
            "view: expected a text or an integer, got 1.5",
        ),  # type: ignore[arg-type]
        (
            lambda: Localiser(RING).update("b", "on", "a"),
            LocaliserError,
            "belief: expected one over 3 dstates, got 'b'",
        ),  # type: ignore[arg-type]
        (
            lambda: Localiser(RING).update(Belief(np.ones(2) / 2, 0.0), "on", "a"),
            LocaliserError,
            "expected one over 3 dstates",
        ),
        (
            lambda: Localiser(RING).update(Localiser(RING).prior, 3, "a"),
            TraceError,
            "action: expected a name",
        ),  # type: ignore[arg-type]
    ],
)
def test_localiser_refuses_bad_input(make: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        make()


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (IMAGES[0][:5], "expected 12 ranges each, as the recogniser learnt"),
        (["x"] * 12, "expected a table of numbers"),
        (1.0, "expected 12 ranges each"),
    ],
)
def test_localiser_refuses_a_bad_image(image: Any, message: str) -> None:
    with pytest.raises(PerceptionError, match=message):
        Localiser(RING, recogniser().fit(IMAGES, AT)).start(image=image)


def test_localiser_refuses_an_image_that_is_not_finite() -> None:
    with pytest.raises(PerceptionError, match="expected finite numbers"):
        Localiser(RING, PlaceRecogniser().fit(IMAGES, AT)).start(image=np.full(12, np.nan))


# the shell


@pytest.fixture
def files(tmp_path: Path) -> Path:
    walk = moore(12, 4, steps=400, seed=0)
    ssh_map = true_map(walk.truth, walk.trace)
    ssh_map.save(tmp_path / "maps.json")
    walk.trace.save(tmp_path / "mapped.jsonl")
    drive(ssh_map, 30, 1, kidnapped=15)[0].save(tmp_path / "other.jsonl")
    return tmp_path


def test_localise_prints_beliefs(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    maps, other = str(files / "maps.json"), str(files / "other.jsonl")
    expected = [b.to_dict() for b in Localiser(SSHMap.load(maps)).beliefs(Trace.load(other))]
    assert main(["localise", maps, other, "--json", "--plot", str(files / "beliefs.png")]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["beliefs"] == [{"step": i, **belief} for i, belief in enumerate(expected)]
    assert told["chances"] == {"misread": 0.01, "slipped": 0.01, "unmapped": 0.1, "reentered": 0.1}
    assert (files / "beliefs.png").read_bytes().startswith(b"\x89PNG")
    assert main(["localise", maps, other]) == 0
    head, columns, *rows = capsys.readouterr().out.splitlines()
    assert "lost at step" in head
    assert "the belief collapsed at step 15" in head
    assert " ".join(columns.split()) == (
        "step action seen dstate probability nowhere entropy normaliser"
    )
    assert len(rows) == 30
    settings = ["--set=zero_one=true", "--set=misread=0.2", "--json"]
    trace = str(files / "mapped.jsonl")
    assert main(["localise", maps, other, "--trace", trace, *settings]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["chances"] == {"misread": 0.2, "slipped": 0.0, "unmapped": 0.0, "reentered": 1.0}


@pytest.mark.filterwarnings("always")
def test_localise_uses_the_first_of_several_maps_with_a_note(
    files: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    several = files / "several.json"
    several.write_text(json.dumps({"maps": [RING.to_dict(), RING.to_dict()]}))
    other = (files / "other.jsonl").read_bytes()
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(other)))
    assert main(["localise", str(several), "-"]) == 0
    assert (
        "several.json: the first of 2 maps is taken; choose one with --map"
        in capsys.readouterr().err
    )
    assert main(["localise", str(several), str(files / "other.jsonl"), "--map", "2", "--json"]) == 0
    told = capsys.readouterr()
    assert (json.loads(told.out)["map"], json.loads(told.out)["dstates"], told.err) == (2, 3, "")


def test_localise_reads_images_and_recognise_prints_nowhere(
    files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    RING.save(files / "ring.json")
    save(recogniser().fit(IMAGES, AT), files / "r.skops")
    fresh, _ = pictures(3, 1, seed=5)
    _imaged([*fresh, fresh[0], np.full(12, 0.2), np.full(12, 20.0)]).save(files / "images.jsonl")
    words = [
        str(files / "ring.json"),
        str(files / "images.jsonl"),
        "--recogniser",
        str(files / "r.skops"),
    ]
    assert main(["localise", *words, "--json"]) == 0
    beliefs = json.loads(capsys.readouterr().out)["beliefs"]
    assert [b["dstate"] for b in beliefs[:4]] == [0, 1, 2, 0]
    assert beliefs[-1]["verdict"] == "nowhere"
    assert main(["recognise", str(files / "r.skops"), str(files / "images.jsonl"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == [0, 1, 2, 0, None, None]
    assert main(["recognise", str(files / "r.skops"), str(files / "images.jsonl")]) == 0
    assert capsys.readouterr().out.splitlines()[-1].split() == ["5", "nowhere"]


def test_localise_errors_are_one_line(files: Path, refuses: Callable[..., None]) -> None:
    maps, other = str(files / "maps.json"), str(files / "other.jsonl")
    (files / "none.json").write_text('{"maps": []}')
    _imaged(IMAGES).save(files / "images.jsonl")
    save(recogniser().fit(IMAGES, AT + 20), files / "r.skops")
    for words, message in [
        (
            [str(files / "none.json"), other],
            "none.json: expected maps, got none",
        ),
        ([maps, other, "--map", "2"], "expected the number of a map, 1 to 1, or its id, got '2'"),
        (
            [maps, other, "--set", "misread=2"],
            "misread: expected a probability from 0 to 1, got 2.0",
        ),
        (
            [maps, other, "--trace", other],
            "maps.json: map: labels: expected 30, one for each step of the trace",
        ),
        (
            [maps, str(files / "images.jsonl")],
            "images.jsonl: view: expected the views of the map, got images only",
        ),
        (
            [maps, str(files / "images.jsonl"), "--recogniser", str(files / "r.skops")],
            "r.skops: recogniser: expected the dstates 0 to",
        ),
        ([maps, other, "--recogniser", maps], "expected a .skops file"),
        ([other, maps], "other.jsonl: expected a file of maps, got a trace"),
    ]:
        refuses(["localise", *words], message)


def test_localise_writes_json_of_a_trace_with_stars(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stars = [(1, 0, 0, 0), (1, 0, 1, 0), (0, 0, 1, 0)]
    Trace.from_steps("abc", ["travel"] * 2, stars=stars).save(tmp_path / "t.jsonl")
    trace, maps = str(tmp_path / "t.jsonl"), str(tmp_path / "maps.json")
    assert main(["solve", trace, "-q", "-o", maps]) == 0
    capsys.readouterr()
    assert main(["localise", maps, trace, "--json"]) == 0
    beliefs = json.loads(capsys.readouterr().out)["beliefs"]
    assert [belief["dstate"] for belief in beliefs] == [0, 1, 2]
