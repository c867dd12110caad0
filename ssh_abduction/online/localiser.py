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
by a recogniser's distances (perception/likelihood.py). Then

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

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssh_abduction.data.checks import an_instance
from ssh_abduction.data.errors import LocaliserError, MapError, TraceError, brief, named
from ssh_abduction.data.maps import SSHMap, check_labels, checked_map
from ssh_abduction.data.trace import Action, Step, Trace, View, checked_trace
from ssh_abduction.online.belief import AKIN, NOVEL, TINY, Belief, Observation
from ssh_abduction.online.chances import Chances
from ssh_abduction.online.estimates import Move, Moves, view_ratios

if TYPE_CHECKING:
    from perception.likelihood import ImageLikelihood


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
        self._moves = Moves(ssh_map, trace)
        self._seen = None if recogniser is None else self._likelihood(recogniser)

    def __repr__(self) -> str:
        reads = "views" if self._seen is None else "images"
        return f"Localiser({self._number} dstates, {reads}, {self.chances})"

    @property
    def prior(self) -> Belief:
        """The belief before anything is observed: all dstates are equally likely."""
        unmapped = self.chances.unmapped
        return Belief(_frozen(np.full(self._number, (1 - unmapped) / self._number)), unmapped)

    def start(self, view: View | None = None, image: ArrayLike | None = None) -> Belief:
        """Compute the belief after the first observation.

        Without view and image it is the prior: all dstates are equally likely.

        Args:
            view: The view, for a localiser without a recogniser.
            image: The image, of shape (d,), for a localiser with a recogniser: laser ranges in
                metres, or another kind of image that the recogniser was trained on.

        Raises:
            TraceError: The view is malformed.
            LocaliserError: There is an image and no recogniser.
            PerceptionError: The recogniser cannot read the image.
        """
        return self._weighed(self.prior, self._observation(view, image))

    def update(
        self,
        belief: Belief,
        action: Action | str,
        view: View | None = None,
        image: ArrayLike | None = None,
    ) -> Belief:
        """Compute the belief after an action and the next observation.

        Without view and image, only the action counts.

        Args:
            belief: The belief before the action.
            action: The action, or its name. If the turns of the map are named by their angles, such
                as "turn 91.3", give a turn as an Action with its bearing.
            view: The view after it, for a localiser without a recogniser.
            image: The image after it, of shape (d,), for a localiser with a recogniser: laser
                ranges in metres, or another kind of image that the recogniser was trained on.

        Raises:
            TraceError: The action or the view is malformed.
            LocaliserError: The belief is of another map, or there is an image and no recogniser.
            PerceptionError: The recogniser cannot read the image.
        """
        if not isinstance(belief, Belief) or belief.probabilities.shape != (self._number,):
            raise LocaliserError(
                f"belief: expected one over {self._number} dstates, got {brief(belief)}; "
                "begin with start()"
            )
        move = self._moves.move(Action.of(action))
        return self._after(belief, move, self._observation(view, image))

    def beliefs(self, trace: Trace) -> Iterator[Belief]:
        """Yield the belief after each step of another trace.

        Before the first step of each drive, all dstates are equally likely. A localiser with a
        recogniser reads the images of the trace and ignores its views.

        Raises:
            TraceError: No step has a view, and there is no recogniser.
            PerceptionError: The images cannot be read.
        """
        observed = self._observed(checked_trace(trace))
        belief = self._weighed(self.prior, next(observed))
        yield belief
        for step, action, seen in zip(trace.steps[1:], trace.actions, observed, strict=True):
            turned = None if step.displacement is None else step.displacement[2]
            belief = (
                self._weighed(self.prior, seen)
                if action.starts
                else self._after(belief, self._moves.move(action, turned), seen)
            )
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

    def _after(self, belief: Belief, move: Move, seen: Observation | None) -> Belief:
        """Compute the belief after an action and an observation, and whether the robot is lost."""
        found = self._weighed(self._moved(belief, move), seen, self._alike(belief.seen, move, seen))
        sure = belief.entropy if belief.sure is None and found.collapsed else belief.sure
        if sure is None or (not found.collapsed and found.found_again(sure)):
            return found
        return replace(found, sure=sure)

    def _moved(self, belief: Belief, move: Move) -> Belief:
        """Compute the belief after an action and before the observation: the sum in equation 2."""
        chances, p = self.chances, belief.probabilities
        links = self._moves.links(move)
        # `anywhere` is the probability that the robot was in the map and that the action slipped or
        # has no link. Then the map does not say where the robot is now.
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

    def _alike(self, before: Observation | None, move: Move, seen: Observation | None) -> float:
        """Compute p(o'|akin) / q(o') for two observations with an action between them."""
        links = self._moves.links(move)
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
        follows = (
            float((links.leads @ shares)[seen.where] @ seen.ratio)
            * self._number
            / (self._number + 1)
        )
        return (count * follows + 1 - seen.novel) / (count + 1) + seen.novel

    def _weighed(self, expected: Belief, seen: Observation | None, alike: float = 1.0) -> Belief:
        """Compute the belief after an observation o: the product in equation 2, normalised."""
        weights = self._products(expected, seen)
        unknown = expected.akin * alike + 1 - expected.akin  # p(o|nowhere) / q(o)
        nowhere = expected.nowhere * unknown
        normaliser = total = float(weights.sum()) + nowhere
        # The observation is impossible by the belief before it, so localisation restarts.
        if not total:
            weights, nowhere = self._products(self.prior, seen), self.prior.nowhere
            total = float(weights.sum()) + nowhere
        # The observation is impossible at every dstate, so the robot is nowhere.
        if not total:
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
        """Multiply the probability of each dstate x by p(o|x) / q(o). The result is (N,)."""
        p = expected.probabilities
        if seen is None:
            return p.copy()
        products = self.chances.misread * p
        products[seen.where] += (1 - self.chances.misread) * seen.ratio * p[seen.where]
        return products

    def _likelihood(self, recogniser: Any) -> ImageLikelihood:
        """Make the object that computes how probable an image is at each dstate."""
        from perception.likelihood import ImageLikelihood

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


def _frozen(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Make an array read-only, and return it."""
    values.flags.writeable = False
    return values
