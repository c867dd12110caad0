"""Locate a robot in a known map by Markov localisation over dstates.

A dstate (distinctive state) is a place and the direction that the robot faces there.

Reference: Kuipers & Beeson 2002, equations 1 to 4.

>>> from ssh_abduction import Theory, Trace, solve
>>> trace = Trace.from_steps("abcbabcba", ["on"] * 8)
>>> localiser = Localiser(solve(trace, Theory.causal()).maps[0])
>>> for belief in localiser.beliefs(Trace.from_steps("bcb", ["on", "on"])):
...     print(belief)
unsure: dstate 1 with probability 0.457; nowhere 0.082; entropy 1.4 bits
located: dstate 2 with probability 0.956; nowhere 0.042; entropy 0.3 bits
located: dstate 3 with probability 0.974; nowhere 0.021; entropy 0.2 bits

A belief says how probable it is that the robot is at dstate x', having done the action a and then
observed o:

    p(x'|a,o) = α p(o|x') ∫ p(x'|x,a) p(x) dx          (1)   Markov localisation
    p(x'|a,o) = α p(o|x') Σ_x p(x'|x,a) p(x)           (2)   as there are finitely many dstates
    p(v|x) = n(x,v) / n(x),                            (3)   estimated from the steps of a
    p(x'|x,a) = n(x,a,x') / n(x,a)                           labelled trace
    p(v|x) = 1 if x shows v, else 0;                   (4)   if the map holds without exception
    p(x'|x,a) = 1 if a link leads there, else 0

A map without its trace gives (4); a map with its trace gives (3). Robots make errors, so `Chances`
gives the probabilities that (3) and (4) do not hold. There is also one more hypothesis: the robot
is *nowhere*, that is, at no dstate of the map. Let f be (3) or (4), or the probability of an image
by a recogniser's distances (perception/recognition.py). Then

    p(o|x)        = (1 - misread) f(o|x) + misread q(o)
    q(o)          = (Σ_x f(o|x) + g(o)) / (N + 1)
    p(x'|x,a)     = (1 - slipped) f(x'|x,a) + slipped e(x')
                    or e(x') if the map has no link for a at x
    p(x'|nowhere) = reentered / N
    e(x')         = (1 - unmapped) / N,  e(nowhere) = unmapped

e is the prior of global localisation. q(o) is the probability of an observation at an unknown
place. Such a place looks like one of the N dstates, or like none of them (g). All these N + 1 cases
are equally likely.

There are two kinds of places outside the map, which are equally likely when the robot leaves the
map. At a *strange* place, earlier observations predict nothing. At a place *akin* to the map, the
next observation is distributed as in the map on average. The average is over the n dstates that
look like o and have a link for a:

    p(o'|strange) = q(o')
    p(o'|akin)    = (n · mean over these x of Σ_x' f(x'|x,a) f(o'|x') + q(o')) / (n + 1)
                    or q(o') if o' is novel: it looks like none of the dstates

Without the second kind, a robot in another maze would be located in this one, because the views
after turns fit any maze. All p(o|·) are divided by q(o), which changes no belief. This has two
purposes: the weights of views and of images are comparable, and the normaliser compares the
probability of an observation with that at an unknown place.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from enum import Enum
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssh_abduction.data.checks import a_number, an_instance
from ssh_abduction.data.errors import LocaliserError, MapError, TraceError, brief, named
from ssh_abduction.data.maps import SSHMap, check_labels, checked_map
from ssh_abduction.data.odometry import Displacement, Odometry, checked_displacement
from ssh_abduction.data.star import Star
from ssh_abduction.data.trace import Action, Step, Trace, View, checked_trace
from ssh_abduction.online.estimates import (
    NOVEL,
    Away,
    DeadReckoning,
    Links,
    Motion,
    Moves,
    Observation,
    Stars,
    view_ratios,
)

if TYPE_CHECKING:
    from perception.recognition import ImageLikelihood

# Dead reckoning follows a robot outside the map for this many steps.
MOST_AWAY = 20
# The robot is located if one dstate has at least this probability.
LOCATED = 0.9
# A belief has collapsed if by this belief the observation is less than this many times as probable
# as at an unknown place. This is evidence of ten to one, which Jeffreys calls strong.
COLLAPSED = 0.1
# The probability that unknown places are akin to those of the map, before anything is seen there.
AKIN = 0.5
# A lost robot is found again if the entropy of its belief is at most this many bits higher than
# before it was lost.
AS_SURE = 0.1
# Smaller probabilities are left out of JSON, as nearly all of 10,000 dstates have about 0.
LEAST_LISTED = 0.001
# Keeps logarithms finite.
TINY = np.finfo(float).tiny


class BeliefVerdict(Enum):
    """A belief summed up in one word.

    If several words apply, NOWHERE is preferred to LOCATED, and LOCATED to LOST.
    """

    LOCATED = "located"  # one dstate has at least a probability of 0.9
    UNSURE = "unsure"  # no dstate is that probable, as when localisation begins
    # An observation was very improbable by an earlier belief, and the robot has not been found
    # again since.
    LOST = "lost"
    NOWHERE = "nowhere"  # the robot is at no dstate of the map, with a probability above 0.5


@dataclass(frozen=True, eq=False)
class Belief:
    """The probabilities that a robot is at each dstate of a map, or nowhere in it.

    Attributes:
        probabilities: The probability of each dstate by id, of shape (N,), read-only. Together with
            `nowhere` they sum to 1.
        nowhere: Probability that the robot is at no dstate of the map.
        normaliser: Probability of the last observation by the belief before it, divided by its
            probability at an unknown place: 1 / (α q(o)) of equation 2. Below 0.1
            the belief has collapsed.
        sure: Entropy in bits of the last belief before the collapse; None if the robot is not lost.
        akin: If the robot is nowhere, the probability that the places there are *akin* to the map:
            views follow each other there as in the map.
        seen: The last observation; None if there was none.
        away: The parts of `nowhere` for which dead reckoning knows how the robot moved since it was
            at a dstate. There are such parts if the map has poses and the robot has odometry.
    """

    probabilities: NDArray[np.float64]
    nowhere: float
    normaliser: float = 1.0
    sure: float | None = None
    akin: float = AKIN
    seen: Observation | None = None
    away: tuple[Away, ...] = ()

    def __str__(self) -> str:
        dstate = f"dstate {self.likeliest} with probability {self.probability:.3f}"
        verdict, nowhere = self.verdict.value, f"nowhere {self.nowhere:.3f}"
        return f"{verdict}: {dstate}; {nowhere}; entropy {self.entropy:.1f} bits"

    def __repr__(self) -> str:
        return f"<Belief {self}>"

    @cached_property
    def likeliest(self) -> int:
        """The id of the most probable dstate, even if `nowhere` is more probable."""
        return int(self.probabilities.argmax())

    @property
    def probability(self) -> float:
        """The probability of the most probable dstate."""
        return float(self.probabilities[self.likeliest])

    @cached_property
    def entropy(self) -> float:
        """The entropy in bits. It is 0 if one dstate, or `nowhere`, has the probability 1."""
        p = self.probabilities
        inside = p @ np.log2(np.maximum(p, TINY))
        return max(0.0, -float(inside + self.nowhere * np.log2(max(self.nowhere, TINY))))

    @property
    def collapsed(self) -> bool:
        """Whether `normaliser` is below 0.1: the observation shows that the last belief was wrong.

        The observation is then more than ten times as probable at an unknown place as by that
        belief.
        """
        return bool(self.normaliser < COLLAPSED)  # numpy's bool is not one of JSON

    @property
    def lost(self) -> bool:
        """Whether a belief collapsed (see `collapsed`) and the robot was not found again since.

        The robot is found again if one dstate has a probability of at least 0.9, or if the entropy
        is about as low as before the collapse. The second condition is for maps with dstates that
        no observation distinguishes.
        """
        return self.sure is not None

    @property
    def verdict(self) -> BeliefVerdict:
        """The belief summed up in one word: located, unsure, lost or nowhere."""
        if self.nowhere > 0.5:
            return BeliefVerdict.NOWHERE
        if self.probability >= LOCATED:
            return BeliefVerdict.LOCATED
        return BeliefVerdict.LOST if self.lost else BeliefVerdict.UNSURE

    @property
    def dstate(self) -> int | None:
        """The id of the most probable dstate; None if `nowhere` is above 0.5."""
        return None if self.verdict is BeliefVerdict.NOWHERE else self.likeliest

    def found_again(self, sure: float) -> bool:
        """Whether this belief finds a lost robot again. See `lost` for the conditions.

        Args:
            sure: Entropy in bits of the last belief before the collapse.

        Raises:
            LocaliserError: `sure` is negative or no number.
        """
        a_number("sure", sure, LocaliserError, 0, what="bits of entropy")
        return self.nowhere <= 0.5 and (
            self.probability >= LOCATED or self.entropy <= sure + AS_SURE
        )

    def above(self, least: float) -> tuple[tuple[int, float], ...]:
        """List pairs (dstate, probability), the most probable first.

        Args:
            least: Leave out dstates with a smaller probability.

        Raises:
            LocaliserError: `least` is no probability.
        """
        a_number("least", least, LocaliserError, 0, 1, what="a probability")
        found = np.flatnonzero(self.probabilities >= least)
        found = found[np.argsort(-self.probabilities[found], kind="stable")]
        return tuple((int(s), float(self.probabilities[s])) for s in found)

    def to_dict(self) -> dict[str, Any]:
        """Return the belief as a dict for JSON, as `localise --json` prints it.

        The keys are names of attributes; docs/reference/formats.md has the exceptions.
        """
        return {
            "verdict": self.verdict.value,
            "dstate": self.dstate,
            "probability": _rounded(self.probability),
            "nowhere": _rounded(self.nowhere),
            "entropy": _rounded(self.entropy),
            "normaliser": _rounded(self.normaliser),
            "collapsed": self.collapsed,
            "lost": self.lost,
            "probabilities": [[s, _rounded(p)] for s, p in self.above(LEAST_LISTED)],
        }


def _rounded(value: float) -> float:
    """Round to six significant digits."""
    return float(f"{value:.6g}")


@dataclass(frozen=True, slots=True)
class Chances:
    """The probabilities, for each step, that the robot and the map disagree.

    The defaults are those of other localisers. `misread` and `slipped` are 0.01, as openFABMAP
    leaves 0.01 (1 - sFactor) to what its model does not explain. `unmapped` and `reentered` are
    0.1, as in RTAB-Map (Labbé and Michaud 2013): Bayes/PredictionLC for a robot that comes to an
    unknown place, and 1 - Bayes/VirtualPlacePriorThr for a robot that comes back.

    Attributes:
        misread: Probability that the observation does not fit the dstate where the robot is. For
            example, a person stands in front of the laser, or an image got the wrong view.
        slipped: Probability that the action does not lead where the link of the map says: it
            failed, or the robot was kidnapped.
        unmapped: Probability that the robot is at no dstate of the map if its position is unknown:
            at the start, after a slip, and after an action that has no link.
        reentered: Probability that a robot at no dstate of the map is at one after its next action.
    """

    misread: float = 0.01
    slipped: float = 0.01
    unmapped: float = 0.1
    reentered: float = 0.1

    def __post_init__(self) -> None:
        for chance in fields(self):
            value, mend = getattr(self, chance.name), "take 0 for what never happens"
            a_number(chance.name, value, LocaliserError, 0, 1, what="a probability", mend=mend)

    @classmethod
    def none(cls) -> Chances:
        """Make chances for a map that holds without exception (equation 4).

        Localisation then restarts at an observation that the map does not allow.
        """
        return cls(misread=0.0, slipped=0.0, unmapped=0.0, reentered=1.0)


class Localiser:
    """Computes beliefs about where a robot is in a known map, one after each step.

    Args:
        ssh_map: The map. Its dstates must have the ids 0, 1, 2, …
        recogniser: A recogniser trained on the labels of this map, such as
            `BootstrapLearner.recogniser_`. The localiser then reads images instead of views. None
            reads views.
        trace: The trace that was mapped. What a dstate shows and where actions lead are estimated
            by counting steps of this trace. Its steps may contradict the map. If None, the views
            and links of the map are taken as certain.
        chances: The probabilities of errors; Chances() by default.

    Raises:
        MapError: The map is malformed, or is not of the trace.
        TraceError: `trace` is not a Trace.
        LocaliserError: The recogniser has labels that are no dstates of the map, or `chances` is
            no Chances.
        PerceptionError: The recogniser is not fitted, or is no PlaceRecogniser or pipeline that
            ends with one.
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
        chances, mend = Chances() if chances is None else chances, "make Chances(misread=…)"
        self.chances = an_instance("chances", chances, Chances, LocaliserError, mend=mend)
        self._number = len(ssh_map.dstates)
        if trace is not None:
            check_labels(ssh_map, checked_trace(trace), "map")
        self._shown = view_ratios(ssh_map, trace)
        self._stars: Stars | None = None
        if trace is not None and any(step.star is not None for step in trace):
            self._stars = Stars(ssh_map, trace, self.chances.misread)
        self._moves = Moves(ssh_map, trace)
        self._odometry = (trace.odometry if trace else None) or Odometry()
        self._reckoning = DeadReckoning.of(ssh_map, self._odometry)
        self._seen = None if recogniser is None else self._likelihood(recogniser)

    @property
    def reads_images(self) -> bool:
        """Whether it has a recogniser, so that it reads images instead of views."""
        return self._seen is not None

    def __repr__(self) -> str:
        reads = "images" if self.reads_images else "views"
        return f"Localiser({self._number} dstates, {reads}, {self.chances})"

    @property
    def prior(self) -> Belief:
        """The belief before anything is observed: all dstates are equally likely."""
        unmapped = self.chances.unmapped
        return Belief(_frozen(np.full(self._number, (1 - unmapped) / self._number)), unmapped)

    def start(
        self,
        view: View | None = None,
        image: ArrayLike | None = None,
        star: Sequence[Any] | None = None,
    ) -> Belief:
        """Compute the belief after the first observation.

        Without view, image and star it is the prior: all dstates are equally likely.

        Args:
            view: The view, for a localiser without a recogniser.
            image: The image, of shape (d,), for a localiser with a recogniser: laser ranges in
                metres, or another kind of image that the recogniser was trained on.
            star: The gateways that the robot sees, as in a `Step`. They count if the localiser was
                given the mapped trace, and this trace has stars.

        Raises:
            TraceError: The view or the star is malformed.
            LocaliserError: There is an image and no recogniser.
            PerceptionError: The recogniser cannot read the image.
        """
        gateways = _gateways(star)
        return self._weighed(self.prior, self._with_star(self._observation(view, image), gateways))

    def update(
        self,
        belief: Belief,
        action: Action | str,
        view: View | None = None,
        image: ArrayLike | None = None,
        displacement: Displacement | None = None,
        star: Sequence[Any] | None = None,
    ) -> Belief:
        """Compute the belief after an action and the next observation.

        Without view, image and star, only the action counts.

        Args:
            belief: The belief before the action.
            action: The action, or its name. If the turns of the map are named by their angles, such
                as "turn 91.3", give a turn as an Action with its bearing.
            view: The view after it, for a localiser without a recogniser.
            image: The image after it, of shape (d,), for a localiser with a recogniser: laser
                ranges in metres, or another kind of image that the recogniser was trained on.
            displacement: How the robot moved during the action by odometry, as (dx, dy, dtheta) in
                metres and radians. It counts if the map has poses. Its errors are those of the
                odometry of the mapped trace, or the defaults of `Odometry`.
            star: The gateways that the robot sees after it, as for `start`. After a turn they do
                not count, as the robot saw them before.

        Raises:
            TraceError: The action, the view, the displacement or the star is malformed.
            LocaliserError: The belief is of another map, or there is an image and no recogniser.
            PerceptionError: The recogniser cannot read the image.
        """
        if not isinstance(belief, Belief) or belief.probabilities.shape != (self._number,):
            raise LocaliserError(
                f"belief: expected one over {self._number} dstates, got {brief(belief)}; "
                "begin with start()"
            )
        motion = None
        if displacement is not None:
            displacement = checked_displacement(displacement)
            covariance = self._odometry.covariance(displacement)
            motion = Motion.of(displacement, covariance, self._odometry)
        action, gateways = Action.of(action), _gateways(star)
        seen = self._observation(view, image)
        if action.kind != "turn":
            seen = self._with_star(seen, gateways)
        return self._after(belief, action, seen, motion)

    def beliefs(self, trace: Trace) -> Iterator[Belief]:
        """Yield the belief after each step of another trace.

        Before the first step of each drive, all dstates are equally likely. A localiser with a
        recogniser reads the images of the trace and ignores its views.

        Raises:
            TraceError: No step has a view, and there is no recogniser.
            PerceptionError: The images cannot be read.
        """
        observed = map(self._with_star, self._observed(checked_trace(trace)), self._stars_of(trace))
        belief = self._weighed(self.prior, next(observed))
        yield belief
        odometry = trace.odometry or Odometry()
        for t, (action, seen) in enumerate(zip(trace.actions, observed, strict=True), start=1):
            if action.starts:
                belief = self._weighed(self.prior, seen)
            else:
                displacement, covariance = trace.steps[t].displacement, trace.covariance(t)
                motion = None
                if displacement is not None and covariance is not None:
                    motion = Motion.of(displacement, covariance, odometry)
                belief = self._after(belief, action, seen, motion)
            yield belief

    def _observed(self, trace: Trace) -> Iterator[Observation | None]:
        """Yield the observation of each step of a trace; None for a step without a view."""
        if self._seen is not None:
            from perception.images import images_of

            yield from map(self._spread, self._seen.ratios(images_of(trace)))
            return
        if all(step.view is None for step in trace):
            raise TraceError(
                f"{named(trace.source or 'trace')}: view: expected the views of the map, "
                "got images only; train a recogniser on the map's labels, "
                "and give it to localise --recogniser"
            )
        yield from (self._of_view(step.view) for step in trace)

    def _stars_of(self, trace: Trace) -> Iterator[Star | None]:
        """Yield the star of the first step of each visit, and None for the other steps.

        During turns the robot sees the same gateways again, which tells nothing new.
        """
        yield trace.steps[0].gateways
        for action, step in zip(trace.actions, trace.steps[1:], strict=True):
            yield None if action.kind == "turn" else step.gateways

    def _with_star(self, seen: Observation | None, star: Star | None) -> Observation | None:
        """Add a star to an observation."""
        if star is None or self._stars is None:
            return seen
        found = self._stars.of(star)
        return found if seen is None else seen & found

    def _observation(self, view: View | None, image: ArrayLike | None) -> Observation | None:
        """Make an observation from a view or an image; None if there is neither."""
        if self._seen is not None:
            if image is None:
                return None
            return self._spread(next(self._seen.ratios(np.atleast_2d(np.asarray(image)))))
        if image is not None:
            raise LocaliserError(
                "image: expected a view, as the localiser has no recogniser, got an image; "
                "give it one, or the view"
            )
        return self._of_view(Step(view).view)

    def _of_view(self, view: View | None) -> Observation | None:
        """Return the observation of a view; None without a view."""
        return None if view is None else self._shown.get(view, NOVEL)

    def _spread(self, ratios: NDArray[np.float64]) -> Observation:
        """Make an observation of an image, from the ratios f(o|x) / q(o) of the known dstates x.

        The recogniser was trained on images of these dstates. All others have the ratio 1, as an
        unknown place has.
        """
        assert self._seen is not None
        spread = np.ones(self._number)
        spread[self._seen.classes] = ratios
        return Observation(
            slice(None), spread, max(0.0, 1 - float(ratios.sum()) / (len(ratios) + 1))
        )

    def _after(
        self, belief: Belief, action: Action, seen: Observation | None, motion: Motion | None
    ) -> Belief:
        """Compute the belief after an action and an observation, and whether the robot is lost."""
        move = self._moves.move(action, None if motion is None else motion.displacement[2])
        links = self._moves.links(move)
        if links is not None and self._reckoning and motion is not None and isinstance(move, str):
            links = replace(links, leads=self._reckoning.along(links.leads, motion))
        expected = self._moved(belief, links, motion)
        found = self._weighed(expected, seen, self._alike(belief.seen, links, seen))
        sure = belief.entropy if belief.sure is None and found.collapsed else belief.sure
        if sure is None or (not found.collapsed and found.found_again(sure)):
            return found
        return replace(found, sure=sure)

    def _moved(self, belief: Belief, links: Links | None, motion: Motion | None) -> Belief:
        """Compute the belief after an action and before the observation: the sum in equation 2.

        After a displacement d, the probabilities are multiplied by p(d) / q(d).
        """
        slipped, p = self.chances.slipped, belief.probabilities
        unlinked = p if links is None else links.missing * p
        linked = p - unlinked
        moved = np.zeros(self._number) if links is None else (1 - slipped) * (links.leads @ p)
        # `anywhere` is the probability that the robot was in the map and that the action slipped or
        # has no link. Then the map does not say where the robot is now, but odometry may.
        anywhere, outside = slipped * float(linked.sum()) + float(unlinked.sum()), belief.nowhere
        away: list[Away] = []
        if motion is not None and self._reckoning is not None:
            followed = sum(part.total for part in belief.away)
            anywhere = slipped * (float(linked.sum()) / 2 + float(unlinked.sum()) + followed)
            outside -= followed
            left = Away((1 - slipped) * unlinked + slipped / 2 * linked, motion)
            older = (part.after(motion, 1 - slipped) for part in belief.away)
            found = [self._reckoning.arrivals(p, self.chances.unmapped) for p in (left, *older)]
            moved += sum(arrived for arrived, _ in found)
            away = [stays for _, stays in found]
        unmapped, reentered = self.chances.unmapped, self.chances.reentered
        moved += (anywhere * (1 - unmapped) + outside * reentered) / self._number
        entered = anywhere * unmapped + sum(part.total for part in away[:1])
        stayed = outside * (1 - reentered) + sum(part.total for part in away[1:])
        nowhere = entered + stayed
        akin = (AKIN * entered + belief.akin * stayed) / nowhere if nowhere else AKIN
        return Belief(moved, nowhere, akin=akin, away=tuple(away[:MOST_AWAY]))

    def _alike(
        self, before: Observation | None, links: Links | None, seen: Observation | None
    ) -> float:
        """Compute p(o'|akin) / q(o') for two observations with an action between them."""
        if before is None or seen is None or links is None:
            return 1.0
        # A distribution over the dstates that look like `before` and have a link for the action.
        shares = np.zeros(self._number)
        shares[before.where] = before.ratio
        shares *= 1 - links.missing
        total = float(shares.sum())
        if total <= TINY:
            return 1.0
        shares /= total
        # The effective number of dstates in the average (Kish 1965).
        count = (1 - before.novel) / float(shares @ shares)
        n = self._number
        follows = float((links.leads @ shares)[seen.where] @ seen.ratio) * n / (n + 1)
        return (count * follows + 1 - seen.novel) / (count + 1) + seen.novel

    def _weighed(self, expected: Belief, seen: Observation | None, alike: float = 1.0) -> Belief:
        """Compute the belief after an observation o: the product in equation 2, normalised."""
        weights = self._products(expected, seen)
        unknown = expected.akin * alike + 1 - expected.akin  # p(o|nowhere) / q(o)
        nowhere, away = expected.nowhere * unknown, expected.away
        normaliser = total = float(weights.sum()) + nowhere
        # The observation is impossible by the belief before it, so localisation restarts.
        if not total:
            weights, nowhere = self._products(self.prior, seen), self.prior.nowhere
            total, away = float(weights.sum()) + nowhere, ()
        # The observation is impossible at every dstate, so the robot is nowhere.
        if not total:
            nowhere = total = 1.0
            away = ()
        weights /= total
        return Belief(
            _frozen(weights),
            nowhere / total,
            normaliser,
            akin=expected.akin * alike / unknown,
            seen=seen,
            away=tuple(Away(part.probabilities * (unknown / total), part.motion) for part in away),
        )

    def _products(self, expected: Belief, seen: Observation | None) -> NDArray[np.float64]:
        """Multiply the probability of each dstate x by p(o|x) / q(o). The result is (N,)."""
        p = expected.probabilities
        if seen is None:
            return p.copy()
        products = self.chances.misread * p
        products[seen.where] += (1 - self.chances.misread) * seen.ratio * p[seen.where]
        return products

    def _likelihood(self, recogniser: Any) -> ImageLikelihood:
        """Make the object that computes how probable an image is at each dstate."""
        from perception.recognition import ImageLikelihood

        found = ImageLikelihood.of(recogniser)
        classes = found.classes
        if classes.dtype.kind not in "iu" or classes.min() < 0 or classes.max() >= self._number:
            raise LocaliserError(
                f"recogniser: expected the dstates 0 to {self._number - 1} of the map as labels, "
                f"got {brief(classes.tolist())}; train it on the labels of this map"
            )
        return found


def _checked(ssh_map: object) -> SSHMap:
    """Return the map if its dstates have the ids 0, 1, 2, …; raise MapError otherwise."""
    ssh_map = checked_map(ssh_map)
    ids = [s.id for s in ssh_map.dstates]
    if not ids or ids != list(range(len(ids))):
        raise MapError(
            f"map: dstates: expected the ids 0, 1, 2, …, got {brief(ids)}; renumber them"
        )
    used = {*ssh_map.dstate_at} | {s for x, _, y in ssh_map.links for s in (x, y)}
    if strange := used - {*ids}:
        raise MapError(
            f"map: expected dstates 0 to {len(ids) - 1} in labels and links, "
            f"got {brief(min(strange))}; mend the map"
        )
    return ssh_map


def _gateways(star: Any) -> Star | None:
    """Check a star, as in a `Step`. Raises TraceError."""
    return Step(None, star=star).gateways


def _frozen(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Make an array read-only, and return it."""
    values.flags.writeable = False
    return values
