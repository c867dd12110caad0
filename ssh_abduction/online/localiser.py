"""Where in a known map is the robot? Markov localisation over dstates (Kuipers & Beeson 2002, equations 1 to 4).

>>> from ssh_abduction import Theory, Trace, solve
>>> trace = Trace.from_steps("abcbabcba", ["on"] * 8)
>>> localiser = Localiser(solve(trace, Theory.causal()).maps[0])
>>> for belief in localiser.beliefs(Trace.from_steps("bcb", ["on", "on"])):
...     print(belief)
unsure: dstate 1 with probability 0.457; nowhere 0.082; entropy 1.4 bits
located: dstate 2 with probability 0.956; nowhere 0.042; entropy 0.3 bits
located: dstate 3 with probability 0.974; nowhere 0.021; entropy 0.2 bits

A belief says how probable it is that the robot is at dstate x, having done the action a and then observed o:

    p(x'|a,o) = α p(o|x') ∫ p(x'|x,a) p(x) dx                (1)   Markov localisation
    p(x'|a,o) = α p(o|x') Σ_x p(x'|x,a) p(x)                 (2)   as there are finitely many dstates
    p(v|x) = n(x,v) / n(x),  p(x'|x,a) = n(x,a,x') / n(x,a)  (3)   estimated from the steps of a labelled trace
    p(v|x) = 1 if x shows v, else 0;  p(x'|x,a) = 1 if a link leads there, else 0     (4)   where the map holds without exception

A map alone says (4), and so does the trace that it explains. As no robot is without faults, `Chances` lays over them how likely it is that they do not hold, and one hypothesis
more, that the robot is nowhere that the map knows. With f for (3) or (4), or for what a recogniser's distances say of an image (perception/likelihood.py):

    p(o|x)        = (1 - misread) f(o|x) + misread q(o)
    q(o)          = (Σ_x f(o|x) + g(o)) / (N + 1)              a place of which nothing is known looks like one of the N dstates, or like none of them (g), each as likely
    p(x'|x,a)     = (1 - slipped) f(x'|x,a) + slipped e(x')    or e(x') where the map has no link for a at x
    p(x'|nowhere) = reentered / N
    e(x')         = (1 - unmapped) / N,  e(nowhere) = unmapped     the prior of global localisation

Nowhere is of two kinds, equally likely when the robot gets there: strange, where nothing follows from what was seen before, and akin to the map, where what follows is what follows
in the map on average, over the n dstates that look like o and have a link for a:

    p(o'|strange) = q(o')
    p(o'|akin)    = (n · mean over these x of Σ_x' f(x'|x,a) f(o'|x') + q(o')) / (n + 1)      of a novel o': q(o')

Without the second kind a robot in another maze would be taken to be in this one, as what a turn shows is no surprise in any maze. All p(o|·) are divided by q(o), which changes no belief: so
views and images are weighed alike, and the normaliser says how probable an observation was, compared with a place of which nothing is known.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from enum import Enum
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from ssh_abduction.data.checks import a_number
from ssh_abduction.data.errors import LocaliserError, MapError, TraceError, brief, is_finite, named
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Action, Step, Trace, View, checked_trace

if TYPE_CHECKING:
    from perception.likelihood import ImageLikelihood

# A dstate that is as probable as this is where the robot is.
LOCATED = 0.9
# A belief has collapsed where an observation is so much less probable than at a place of which nothing is known: evidence of ten to one against it, which Jeffreys calls strong.
COLLAPSED = 0.1
# The share of unknown places that are taken to be akin to those of the map, before anything is seen of them.
AKIN = 0.5
# A robot that was lost is found again where its belief is as sure as it was before, to so many bits.
AS_SURE = 0.1
# Probabilities below this are left out of JSON: of 10,000 dstates nearly all have next to none.
LEAST_TOLD = 0.001
_TINY = np.finfo(float).tiny


class Verdict(Enum):
    """What a belief comes to."""

    LOCATED = "located"  # one dstate has at least the probability LOCATED
    UNSURE = "unsure"  # several dstates are possible, as when localisation begins
    LOST = "lost"  # the robot was not where it was believed to be, and it is not as sure again yet
    NOWHERE = "nowhere"  # more likely than not the robot is at no dstate of the map


@dataclass(frozen=True, slots=True)
class Chances:
    """How likely it is, at each step, that what a map says does not hold. Probabilities, from 0 to 1.

    misread    the observation is not of the dstate that the robot is at: a person in front of the laser, a wrong cluster
    slipped    the action does not lead where the link says: it failed, or the robot was kidnapped
    unmapped   a robot of which nothing is known is at no dstate of the map. It also says where an action leads of which the map has no link
    reentered  a robot that is at no dstate of the map is at one after its next action

    Faults are taken to be rare: one step in a hundred, as in openFABMAP, which leaves 0.01 (1 - sFactor) to what its model does not say. 0.1 is what RTAB-Map (Labbé and Michaud 2013)
    gives by default to a robot's coming to a place that it does not know (Bayes/PredictionLC), and to its coming back (1 - Bayes/VirtualPlacePriorThr).
    """

    misread: float = 0.01
    slipped: float = 0.01
    unmapped: float = 0.1
    reentered: float = 0.1

    def __post_init__(self) -> None:
        for chance in fields(self):
            value = getattr(self, chance.name)
            if not is_finite(value) or not 0 <= value <= 1:
                raise LocaliserError(
                    f"{chance.name}: expected a probability from 0 to 1, got {brief(value)}; take 0 for what never happens"
                )

    @classmethod
    def none(cls) -> Chances:
        """The map holds without exception (equation 4). An observation that it does not allow then begins localisation anew."""
        return cls(misread=0.0, slipped=0.0, unmapped=0.0, reentered=1.0)


@dataclass(frozen=True, eq=False, slots=True)
class Observation:
    """What a robot observes, as far as it tells dstates apart.

    where  some dstates
    ratio  f(o|x) / q(o) of each of them; it is 0 of all others
    novel  how likely it is that a place which is equally likely any dstate or like none of them is like none, once it has looked like this
    """

    where: NDArray[np.intp] | slice
    ratio: NDArray[np.float64]
    novel: float


_NOVEL = Observation(np.empty(0, np.intp), np.empty(0), 1.0)


@dataclass(frozen=True, eq=False)
class Belief:
    """Where a robot may be, once it has observed something.

    probabilities  of each dstate, (N,), read-only. With `nowhere` they sum to 1
    nowhere        the probability that the robot is at no dstate of the map
    normaliser     how probable the observation was by the belief before it, divided by how probable it is at a place of which nothing is known: 1 / (α q(o)) of
                   equation 2. Below COLLAPSED the belief has collapsed: the robot was not where it was believed to be
    sure           the entropy, in bits, of the belief before the one that collapsed; None where the robot is not lost
    akin           the probability that places are akin to those of the map, where the robot is nowhere
    seen           the observation, which says what is seen next among places that are akin; None where there was none
    """

    probabilities: NDArray[np.float64]
    nowhere: float
    normaliser: float = 1.0
    sure: float | None = None
    akin: float = AKIN
    seen: Observation | None = None

    def __str__(self) -> str:
        dstate = f"dstate {self.likeliest} with probability {self.probability:.3f}"
        return f"{self.verdict.value}: {dstate}; nowhere {self.nowhere:.3f}; entropy {self.entropy:.1f} bits"

    def __repr__(self) -> str:
        return f"<Belief {self}>"

    @cached_property
    def likeliest(self) -> int:
        """The most probable dstate, whether or not the robot is likelier to be nowhere. Of several the first."""
        return int(self.probabilities.argmax())

    @property
    def probability(self) -> float:
        """Of the most probable dstate."""
        return float(self.probabilities[self.likeliest])

    @cached_property
    def entropy(self) -> float:
        """Of the belief, in bits: 0 where the robot is at one dstate, or nowhere, for certain."""
        p = self.probabilities
        inside = p @ np.log2(np.maximum(p, _TINY))
        return max(0.0, -float(inside + self.nowhere * np.log2(max(self.nowhere, _TINY))))

    @property
    def collapsed(self) -> bool:
        """Whether the observation was far less probable by the belief before it than where nothing is known."""
        return self.normaliser < COLLAPSED

    @property
    def lost(self) -> bool:
        """Whether a belief collapsed, and the robot has not been found since: neither is one dstate certain, nor is the belief as sure as it was before. Where dstates
        cannot be told apart by anything that a robot sees and does, none of them is ever certain."""
        return self.sure is not None

    @property
    def verdict(self) -> Verdict:
        """What the belief comes to."""
        if self.nowhere > 0.5:
            return Verdict.NOWHERE
        if self.probability >= LOCATED:
            return Verdict.LOCATED
        return Verdict.LOST if self.lost else Verdict.UNSURE

    @property
    def dstate(self) -> int | None:
        """Where the robot most probably is; None for nowhere that the map knows."""
        return None if self.verdict is Verdict.NOWHERE else self.likeliest

    def found_again(self, sure: float) -> bool:
        """Whether a robot that was lost is not lost any more, by this belief.

        sure  the entropy, in bits, of the belief before it was lost
        """
        a_number("sure", sure, LocaliserError, 0, what="bits of entropy")
        return self.nowhere <= 0.5 and (
            self.probability >= LOCATED or self.entropy <= sure + AS_SURE
        )

    def above(self, least: float) -> tuple[tuple[int, float], ...]:
        """The dstates of at least this probability, and their probabilities, the most probable one first."""
        a_number("least", least, LocaliserError, 0, 1, what="a probability")
        found = np.flatnonzero(self.probabilities >= least)
        found = found[np.argsort(-self.probabilities[found], kind="stable")]
        return tuple((int(s), float(self.probabilities[s])) for s in found)

    def to_dict(self) -> dict[str, Any]:
        """The belief as `localize --json` prints it (docs/formats.md)."""
        return {
            "verdict": self.verdict.value,
            "dstate": self.dstate,
            "probability": _rounded(self.probability),
            "nowhere": _rounded(self.nowhere),
            "entropy": _rounded(self.entropy),
            "normaliser": _rounded(self.normaliser),
            "collapsed": self.collapsed,
            "lost": self.lost,
            "probabilities": [[s, _rounded(p)] for s, p in self.above(LEAST_TOLD)],
        }


class Localiser:
    """Follows a robot in a map: beliefs go in, and beliefs come out.

    ssh_map     the map. Its links and views say (4)
    recogniser  reads images in place of views: one that was trained on the labels of this map, such as `BootstrapLearner.recogniser_`
    trace       the trace that the labels of the map belong to: probabilities are then estimated from it (3). It may break the rules of a map
    chances     how likely it is that these do not hold

    Raises MapError, TraceError, LocaliserError, and PerceptionError for a recogniser whose distances cannot be read.
    """

    def __init__(
        self,
        ssh_map: SSHMap,
        recogniser: Any = None,
        *,
        trace: Trace | None = None,
        chances: Chances | None = None,
    ) -> None:
        self.ssh_map = _checked(ssh_map)
        self.chances = Chances() if chances is None else chances
        if not isinstance(self.chances, Chances):
            raise LocaliserError(
                f"chances: expected Chances, got {brief(chances)}; make them with Chances(misread=…)"
            )
        self._number = len(ssh_map.dstates)
        if trace is not None and len(checked_trace(trace)) != len(ssh_map.labels):
            raise MapError(
                f"map: labels: expected {len(trace)}, one for each step of the trace, got {len(ssh_map.labels)}; take the trace that the map was found for"
            )
        self._shown = self._view_ratios(trace)
        self._links = self._transitions(trace)
        self._followed: dict[
            tuple[Observation, str, Observation], float
        ] = {}  # what _alike found out of views
        self._seen = None if recogniser is None else self._likelihood(recogniser)

    def __repr__(self) -> str:
        return f"Localiser({self._number} dstates, {'views' if self._seen is None else 'images'}, {self.chances})"

    @property
    def prior(self) -> Belief:
        """The belief of global localisation: nothing is known, and each dstate is as likely as any other."""
        unmapped = self.chances.unmapped
        return Belief(_frozen(np.full(self._number, (1 - unmapped) / self._number)), unmapped)

    def start(self, view: View | None = None, image: ArrayLike | None = None) -> Belief:
        """The belief after the first observation, which is none where neither is given. Raises TraceError, LocaliserError, PerceptionError."""
        return self._weighed(self.prior, self._observation(view, image))

    def update(
        self,
        belief: Belief,
        action: Action | str,
        view: View | None = None,
        image: ArrayLike | None = None,
    ) -> Belief:
        """The belief after an action and what was observed then, which is nothing where neither is given: equations 1 and 2.

        image  ranges in metres, (d,). Raises TraceError, LocaliserError, PerceptionError.
        """
        if not isinstance(belief, Belief) or belief.probabilities.shape != (self._number,):
            raise LocaliserError(
                f"belief: expected one over {self._number} dstates, got {brief(belief)}; begin with start()"
            )
        return self._after(belief, Action.of(action).name, self._observation(view, image))

    def beliefs(self, trace: Trace) -> Iterator[Belief]:
        """The belief after each step of another trace, from a prior that knows nothing.

        With a recogniser the images of the trace are read, and its views are not. Raises TraceError where no step says what was seen, and PerceptionError.
        """
        observed = self._observed(checked_trace(trace))
        belief = self._weighed(self.prior, next(observed))
        yield belief
        for action, seen in zip(trace.actions, observed, strict=True):
            belief = self._after(belief, action.name, seen)
            yield belief

    def _observed(self, trace: Trace) -> Iterator[Observation | None]:
        """What each step of a trace says of where the robot is."""
        if self._seen is not None:
            from perception.images import images_of

            yield from map(self._spread, self._seen.ratios(images_of(trace)))
            return
        if all(step.view is None for step in trace):
            raise TraceError(
                f"{named(trace.source or 'trace')}: view: expected the views of the map, got images only; train a recogniser on the map's labels, and give it to localize --recogniser"
            )
        yield from (self._of_view(step.view) for step in trace)

    def _observation(self, view: View | None, image: ArrayLike | None) -> Observation | None:
        if self._seen is not None:
            return (
                None
                if image is None
                else self._spread(next(self._seen.ratios(np.atleast_2d(np.asarray(image)))))
            )
        if image is not None:
            raise LocaliserError(
                "image: expected a view, as the localiser has no recogniser, got an image; give it one, or the view"
            )
        return self._of_view(Step(view).view)

    def _of_view(self, view: View | None) -> Observation | None:
        return None if view is None else self._shown.get(view, _NOVEL)

    def _spread(self, ratios: NDArray[np.float64]) -> Observation:
        """An image, by f(o|x) / q(o) of the recogniser's classes. Of a dstate that it has no image of it is not known how it looks, as of a place that is not in the map."""
        assert self._seen is not None
        spread = np.ones(self._number)
        spread[self._seen.classes] = ratios
        return Observation(
            slice(None), spread, max(0.0, 1 - float(ratios.sum()) / (len(ratios) + 1))
        )

    def _after(self, belief: Belief, action: str, seen: Observation | None) -> Belief:
        """The belief after an action and an observation."""
        found = self._weighed(
            self._moved(belief, action), seen, self._alike(belief.seen, action, seen)
        )
        sure = belief.entropy if belief.sure is None and found.collapsed else belief.sure
        if sure is None or (not found.collapsed and found.found_again(sure)):
            return found
        return replace(found, sure=sure)

    def _moved(self, belief: Belief, action: str) -> Belief:
        """The belief after an action, before anything is observed: the sum of equation 2."""
        chances, p = self.chances, belief.probabilities
        links = self._links.get(action)
        if links is None:
            moved, anywhere = np.zeros(self._number), 1 - belief.nowhere
        else:
            known = links.leads @ p
            moved = (1 - chances.slipped) * known
            anywhere = chances.slipped * float(known.sum()) + float(links.missing @ p)
        moved += (
            anywhere * (1 - chances.unmapped) + belief.nowhere * chances.reentered
        ) / self._number
        entered, stayed = anywhere * chances.unmapped, belief.nowhere * (1 - chances.reentered)
        akin = (
            (AKIN * entered + belief.akin * stayed) / (entered + stayed)
            if entered + stayed
            else AKIN
        )
        return Belief(moved, entered + stayed, akin=akin)

    def _alike(self, before: Observation | None, action: str, seen: Observation | None) -> float:
        """p(o'|akin) / q(o'), for the observation `before` an action and the one that is `seen` after it."""
        links = self._links.get(action)
        if before is None or seen is None or links is None:
            return 1.0
        key = (before, action, seen)
        if (known := self._followed.get(key)) is not None:
            return known
        alike = 1.0
        shares = np.zeros(self._number)
        shares[before.where] = before.ratio
        shares *= 1 - links.missing
        total = float(shares.sum())
        if total > _TINY:
            shares /= total
            count = (1 - before.novel) / float(
                shares @ shares
            )  # how many dstates the average is over (Kish 1965)
            follows = (
                float((links.leads @ shares)[seen.where] @ seen.ratio)
                * self._number
                / (self._number + 1)
            )
            alike = (count * follows + 1 - seen.novel) / (count + 1) + seen.novel
        if self._seen is None:
            self._followed[key] = alike
        return alike

    def _weighed(self, expected: Belief, seen: Observation | None, alike: float = 1.0) -> Belief:
        """The belief once something is observed: the product of equation 2, and its α.

        expected  the belief before that
        alike     p(o|akin) / q(o)
        """
        weights = self._products(expected, seen)
        unknown = expected.akin * alike + 1 - expected.akin  # p(o|nowhere) / q(o)
        nowhere = expected.nowhere * unknown
        normaliser = total = float(weights.sum()) + nowhere
        if not total:  # no dstate allows this after what was believed, so localisation begins anew
            weights, nowhere = self._products(self.prior, seen), self.prior.nowhere
            total = float(weights.sum()) + nowhere
        if not total:  # and no dstate allows it whatever came before
            nowhere = total = 1.0
        weights /= total
        return Belief(
            _frozen(weights),
            nowhere / total,
            normaliser,
            akin=expected.akin * alike / unknown,
            seen=seen,
        )

    def _products(self, expected: Belief, seen: Observation | None) -> NDArray[np.float64]:
        """p(o|x) / q(o) times the probability of each dstate x."""
        p = expected.probabilities
        if seen is None:
            return p.copy()
        products = self.chances.misread * p
        products[seen.where] += (1 - self.chances.misread) * seen.ratio * p[seen.where]
        return products

    def _view_ratios(self, trace: Trace | None) -> dict[View, Observation]:
        """For each view v the dstates that show it, and f(v|x) / q(v) of these: equation 3, or 4 where no step of the trace is there."""
        counts = Counter[tuple[int, View]]()
        if trace is not None:
            counts.update(
                (x, step.view)
                for x, step in zip(self.ssh_map.labels, trace, strict=True)
                if step.view is not None
            )
        seen = {x for x, _ in counts}
        counts.update(
            (s.id, s.view) for s in self.ssh_map.dstates if s.id not in seen and s.view is not None
        )
        visits = Counter[int]()
        for (x, _), n in counts.items():
            visits[x] += n
        shown: dict[View, list[tuple[int, float]]] = {}
        for (x, view), n in sorted(counts.items(), key=lambda item: item[0][0]):
            shown.setdefault(view, []).append((x, n / visits[x]))
        ratios: dict[View, Observation] = {}
        for view, pairs in shown.items():
            f = np.array([p for _, p in pairs])
            ratios[view] = Observation(
                np.array([x for x, _ in pairs], np.intp), f * ((self._number + 1) / f.sum()), 0.0
            )
        return ratios

    def _transitions(self, trace: Trace | None) -> dict[str, _Links]:
        """For each action where it leads: equation 3, or 4 where the trace does not have it at a dstate."""
        counts = Counter[tuple[int, str, int]]()
        labels = self.ssh_map.labels
        if trace is not None:
            counts.update(
                (x, action.name, y)
                for x, action, y in zip(labels, trace.actions, labels[1:], strict=False)
            )
        tried = {(x, action) for x, action, _ in counts}
        counts.update({link for link in self.ssh_map.links if link[:2] not in tried})
        trials = Counter[tuple[int, str]]()
        for (x, action, _), n in counts.items():
            trials[x, action] += n
        entries: dict[str, list[tuple[int, int, float]]] = {}
        for (x, action, y), n in counts.items():
            entries.setdefault(action, []).append((x, y, n / trials[x, action]))
        links: dict[str, _Links] = {}
        for action, listed in entries.items():
            sources, targets, p = (np.array(column) for column in zip(*listed, strict=True))
            missing = np.ones(self._number)
            missing[sources] = 0.0
            links[action] = _Links(
                sparse.csr_array((p, (targets, sources)), shape=(self._number, self._number)),
                missing,
            )
        return links

    def _likelihood(self, recogniser: Any) -> ImageLikelihood:
        """How probable images are at the dstates that the recogniser knows. Raises LocaliserError where they are not dstates of the map."""
        from perception.likelihood import ImageLikelihood

        found = ImageLikelihood.of(recogniser)
        classes = found.classes
        if classes.dtype.kind not in "iu" or classes.min() < 0 or classes.max() >= self._number:
            raise LocaliserError(
                f"recogniser: expected the dstates 0 to {self._number - 1} of the map as labels, got {brief(classes.tolist())}; train it on the labels of this map"
            )
        return found


@dataclass(frozen=True)
class _Links:
    """Where an action leads.

    leads    p(x'|x,a), (N, N), x' by x: a column for each dstate where it is known
    missing  1 for a dstate where it is not known, else 0, (N,)
    """

    leads: sparse.csr_array
    missing: NDArray[np.float64]


def _checked(ssh_map: object) -> SSHMap:
    if not isinstance(ssh_map, SSHMap):
        raise MapError(
            f"map: expected an SSHMap, got {brief(ssh_map)}; take one of solution.maps, or SSHMap.load"
        )
    ids = [s.id for s in ssh_map.dstates]
    if not ids or ids != list(range(len(ids))):
        raise MapError(
            f"map: dstates: expected the ids 0, 1, 2, …, got {brief(ids)}; renumber them"
        )
    if strange := ({*ssh_map.labels} | {s for x, _, y in ssh_map.links for s in (x, y)}) - {*ids}:
        raise MapError(
            f"map: expected dstates 0 to {len(ids) - 1} in labels and links, got {brief(min(strange))}; mend the map"
        )
    return ssh_map


def _frozen(values: NDArray[np.float64]) -> NDArray[np.float64]:
    values.flags.writeable = False
    return values


def _rounded(value: float) -> float:
    """To six significant digits, as more of them say nothing."""
    return float(f"{value:.6g}")
