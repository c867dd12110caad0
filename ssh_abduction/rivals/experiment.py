"""Experiments that distinguish rival maps (minimal maps of one trace), as plain values."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from ssh_abduction.data.errors import printable
from ssh_abduction.data.schema import PlainData, attributes_of
from ssh_abduction.data.words import counted
from ssh_abduction.rivals.consequences import Consequence
from ssh_abduction.rivals.machines import Seen
from ssh_abduction.solver import Stop


@dataclass(frozen=True, slots=True)
class Expectation:
    """The prediction of some rivals for an untried action."""

    rivals: tuple[int, ...]  # the rivals with this prediction, numbered from 1
    says: Consequence  # the prediction

    def to_dict(self) -> dict[str, Any]:
        """Return the prediction as plain data, as `next --json` prints it."""
        return {"rivals": list(self.rivals), **self.says.to_dict()}


@dataclass(frozen=True, slots=True)
class Untried(PlainData):
    """An action for which at least one rival has no link, and the way to it."""

    way: tuple[str, ...]  # the actions that lead there, along links that all rivals have
    action: str  # the untried action, to be done after these
    expects: tuple[Expectation, ...]  # the different predictions of the rivals
    # The number of rivals that are left in the worst case. All others are refuted.
    worst: int
    pairs: int  # the number of pairs of rivals with different predictions


@dataclass(frozen=True, slots=True)
class Branch:
    """The rest of a plan after an observation."""

    seen: Seen  # the observation
    plan: ExperimentPlan  # the plan for the rivals that predict this observation

    def to_dict(self) -> dict[str, Any]:
        """Return the branch as plain data, as `next --json` prints it."""
        return {"seen": self.seen.to_dict(), **self.plan.to_dict()}


@dataclass(frozen=True, slots=True)
class ExperimentPlan:
    """An experiment as a tree: actions, and a further plan for each observation after them."""

    rivals: tuple[int, ...]  # the rivals that are left, numbered from 1
    # Actions along links that all these rivals have. Empty if no such links distinguish the rivals.
    actions: tuple[str, ...] = ()
    # For each predicted observation after the last action, the plan for the rivals that are then
    # left.
    branches: tuple[Branch, ...] = ()
    # The most informative untried action. Only at the ends of the tree, where one rival is left or
    # known links do not distinguish the rivals. None if there is no such action.
    untried: Untried | None = None

    @property
    def worst(self) -> int:
        """The number of rivals that the whole plan leaves in the worst case."""
        return max((branch.plan.worst for branch in self.branches), default=len(self.rivals))

    @property
    def longest(self) -> int:
        """The greatest number of actions along any branch of the plan, without untried actions."""
        return len(self.actions) + max((branch.plan.longest for branch in self.branches), default=0)

    @property
    def leaves(self) -> Iterator[ExperimentPlan]:
        """The plans without branches at the ends of the tree, one after the other."""
        if not self.branches:
            yield self
        for branch in self.branches:
            yield from branch.plan.leaves

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as plain data, as `next --json` prints it."""
        own = attributes_of(self, "rivals")
        if self.branches:
            own |= attributes_of(self, "actions", "branches")
        return own | (attributes_of(self, "untried") if self.untried else {})


@dataclass(frozen=True, slots=True)
class Prediction(PlainData):
    """The predictions of some rivals for the actions of an experiment."""

    rivals: tuple[int, ...]  # the rivals with these predictions, numbered from 1
    seen: tuple[Seen, ...]  # the predicted observation after each action


@dataclass(frozen=True, slots=True)
class Experiment:
    """A plan of actions to find out which of some rival maps is true. Rivals have numbers from 1.

    Attributes:
        count: The number of rivals.
        alike: Groups of rivals. All rivals of a group predict the same along all their links.
        predictions: The different predictions of the rivals after each of `plan.actions`.
        plan: The experiment as a tree.
        sharing: What all rivals share: "dstates and places", "dstates", or "".
        complete: Whether the rivals are all minimal maps.
        stopped: The limit that ended the search; None if it ended by itself. After a limit there
            may be a better plan.
    """

    count: int
    alike: tuple[tuple[int, ...], ...]
    predictions: tuple[Prediction, ...]
    plan: ExperimentPlan
    sharing: str = ""
    complete: bool = True
    stopped: Stop | None = None

    @property
    def actions(self) -> tuple[str, ...]:
        """The actions to do next, up to the first difference in predictions.

        If no known links distinguish the rivals, these are the way to the untried action, and then
        that action. Empty if there is nothing to do.
        """
        untried = self.plan.untried
        return self.plan.actions or ((*untried.way, untried.action) if untried else ())

    @property
    def worst(self) -> int:
        """The number of rivals that the plan leaves in the worst case."""
        return self.plan.worst

    @property
    def is_settled(self) -> bool:
        """Whether there is nothing left to try.

        This is so if no known links distinguish the rivals, the robot cannot reach any untried
        action, and no limit ended the search.
        """
        return not self.actions and self.stopped is None

    @property
    def sentence(self) -> str:
        """A sentence that describes the experiment and how many rivals it leaves."""
        plan, count = self.plan, self.count
        if count == 1:
            return f"1 map: there is nothing to tell apart; {_untried_in_words(plan.untried)}"
        if plan.branches:
            left = "leaves one of them"
            if plan.worst != 1:
                left = (
                    f"leaves {plan.worst} of them in the worst case, as known links do not tell "
                    "them apart"
                )
            whole = "this"
            if any(branch.plan.branches for branch in plan.branches):
                whole = f"the whole plan takes {counted(plan.longest, 'actions')} at most and"
            text = f"{count} maps: after {_acts(plan.actions)} their predictions differ; "
            is_greedy = len(self.alike) != 2
            more = " (another plan may be shorter or leave fewer)" if is_greedy else ""
            return f"{text}{whole} {left}{more}"
        if self.stopped:
            return f"{count} maps: no experiment was found in time"
        links = "all links" if len(self.alike) == 1 else "all links that all of them know"
        why = {
            "dstates and places": ", as they have the same dstates and places and differ only in "
            "paths",
            "dstates": ", as they have the same dstates",
        }.get(self.sharing, "")
        untried = _untried_in_words(plan.untried)
        return f"{count} maps predict the same along {links}{why}; {untried}"

    @property
    def warning(self) -> str | None:
        """A warning if there may be more maps, or if a limit ended the search; otherwise None."""
        parts = []
        if not self.complete:
            parts.append(
                "there may be other maps that are as good or better, and the experiment ignores "
                "them; let solve list all (-n 0), and search longer if a time limit stopped it"
            )
        if self.stopped:
            parts.append(
                f"the search for the experiment was stopped ({self.stopped}); there may be a "
                "better one"
            )
        return "; ".join(parts) or None

    def to_dict(self) -> dict[str, Any]:
        """Return plain data, as `next --json` prints it (docs/reference/formats.md)."""
        return {
            **attributes_of(self, "count", "complete"),
            "summary": self.sentence,
            **attributes_of(self, "sharing", "alike", "actions", "worst"),
            "longest": self.plan.longest,
            **attributes_of(self, "predictions", "plan", *(["stopped"] if self.stopped else [])),
        }


def _untried_in_words(untried: Untried | None) -> str:
    """Put an untried action and the way to it into words."""
    if untried is None:
        return "known links lead to no untried action"
    way = f", after {_acts(untried.way)}" if untried.way else ""
    if untried.pairs:
        return f"the most informative untried action is '{printable(untried.action)}'{way}"
    several = sum(len(expectation.rivals) for expectation in untried.expects) > 1
    none = "they expect the same of every untried action; " if several else ""
    return f"{none}the nearest untried action is '{printable(untried.action)}'{way}"


def _acts(actions: Sequence[str]) -> str:
    """Join the names of actions with commas."""
    return printable(", ".join(actions))
