"""Parse the command line, with groups of verbs, settings, and hints for misspelt names."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

from ssh_abduction.data.errors import printable
from ssh_abduction.data.words import meant

NUMBERS: dict[Any, str] = {int: "a whole number", float: "a number"}


@dataclass(frozen=True)
class Setting:
    """An option that the user gives as --set NAME=VALUE."""

    name: str  # the name, with underscores
    help: str  # the help text
    # Converts the text of the value. Raises ValueError or argparse.ArgumentTypeError.
    type: Callable[[str], Any] = str
    choices: tuple[str, ...] | None = None  # the texts that are allowed; None if `type` decides
    metavar: str = "TEXT"  # the word for the value in the help
    # Whether the setting may be given several times. Its value is then a list.
    many: bool = False

    @property
    def shown(self) -> str:
        """The setting as the help shows it, such as `star={auto,none}`."""
        return f"{self.name}={'{' + ','.join(self.choices) + '}' if self.choices else self.metavar}"

    def read(self, text: str) -> Any:
        """Convert text to a value. Raise argparse.ArgumentTypeError if it is wrong."""
        if self.choices and text not in self.choices:
            expected = " or ".join(filter(None, (", ".join(self.choices[:-1]), self.choices[-1])))
            hint = meant(text, self.choices)
            raise argparse.ArgumentTypeError(f"expected {expected}, got {text!r}{hint}")
        try:
            return self.type(text)
        except ValueError:
            expected = NUMBERS.get(self.type, "another value")
            raise argparse.ArgumentTypeError(
                f"expected {expected}, got {text!r}; write one"
            ) from None


def true_or_false(text: str) -> bool:
    """Convert "true" or "false" to a bool. Raise ArgumentTypeError for anything else."""
    if text not in ("true", "false"):
        raise argparse.ArgumentTypeError(f"expected true or false, got {text!r}; write one of them")
    return text == "true"


class _Set(argparse.Action):
    """The argparse action of --set: stores VALUE of NAME=VALUE as the option of that name."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        assert isinstance(parser, Parser)
        name, equals, text = str(values).partition("=")
        setting = parser.settings.get(name.strip().replace("-", "_"))
        if setting is None or not equals:
            known = ", ".join(parser.settings)
            hint = f"; write {name}=VALUE" if setting else meant(name, parser.settings)
            raise argparse.ArgumentError(
                self, f"expected NAME=VALUE with a name out of {known}, got {values!r}{hint}"
            )
        if text == "--":
            raise argparse.ArgumentError(self, f"{setting.name}: expected a value, got '--'")
        try:
            value = setting.read(text)
        except argparse.ArgumentTypeError as error:
            raise argparse.ArgumentError(self, f"{setting.name}: {error}") from None
        if setting.many:
            value = [*(getattr(namespace, setting.name) or []), value]
        setattr(namespace, setting.name, value)


class Parser(argparse.ArgumentParser):
    """An argparse parser with settings, groups of verbs, and hints for misspelt names."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.settings: dict[str, Setting] = {}  # of this verb, by name
        # The names of this program's verbs, by their heading in the help.
        self.groups: dict[str, tuple[str, ...]] = {}

    def add(
        self, spec: str, said: str, *, to: argparse._ArgumentGroup | None = None, **details: Any
    ) -> None:
        """Add an argument or an option.

        Args:
            spec: An argument such as "trace"; an option with a value such as "-n --maps K", or
                with choices such as "--by"; or a flag such as "--json".
            said: The help text.
            to: The group in which the help lists it; None for none.
            details: Further arguments of argparse's `add_argument`, by name.
        """
        names = [word for word in spec.split() if word.startswith("-")]
        if not names:
            names = [spec]
        elif words := spec.split()[len(names) :]:
            details["metavar"] = words[0]
        elif not details:
            details["action"] = "store_true"
        (to or self).add_argument(*names, help=said, **details)

    def add_setting(self, spec: str, said: str, default: Any = None, **details: Any) -> None:
        """Add a setting. The parsed options have its value as the attribute of the same name.

        Args:
            spec: The name, with underscores, and perhaps the word for its value: "near METRES".
            said: The help text.
            default: The value if the user does not give the setting.
            details: Other fields of Setting, by name.
        """
        name, _, metavar = spec.partition(" ")
        if not self.settings:
            shown = "change one of the settings that are listed below; may be given again"
            self.add("--set NAME=VALUE", shown, action=_Set, dest=argparse.SUPPRESS)
        if isinstance(default, bool):
            details["type"], metavar = true_or_false, "true|false"
        if metavar:
            details["metavar"] = metavar
        self.settings[name] = Setting(name, said, **details)
        self.set_defaults(**{name: default})

    def format_help(self) -> str:
        """Make the help text, with verbs in groups and with the settings."""
        formatter = self._get_formatter()
        formatter.add_usage(self.usage, self._actions, self._mutually_exclusive_groups)
        formatter.add_text(self.description)
        for group in self._action_groups:
            actions = [
                a
                for a in group._group_actions
                if not (self.groups and isinstance(a, argparse._SubParsersAction))
            ]
            formatter.start_section(group.title)
            formatter.add_text(group.description)
            formatter.add_arguments(actions)
            formatter.end_section()
        for title, names in self.groups.items():
            verbs = [a for a in self._verb_actions() if a.dest in names]
            self._add_section(formatter, title, [(a.dest, a.help or "") for a in verbs])
        settings = [(setting.shown, setting.help) for setting in self.settings.values()]
        if settings:
            self._add_section(formatter, "settings, each given as --set NAME=VALUE", settings)
        for paragraph in (self.epilog or "").split("\n\n"):
            formatter.add_text(paragraph)
        return formatter.format_help()

    def _add_section(
        self, formatter: argparse.HelpFormatter, title: str, rows: Iterable[tuple[str, str]]
    ) -> None:
        formatter.start_section(title)
        for name, text in rows:
            formatter.add_argument(argparse.Action([], name, metavar=name, help=text))
        formatter.end_section()

    def _verb_actions(self) -> Iterable[argparse.Action]:
        for action in self._actions:
            if isinstance(action, argparse._SubParsersAction):
                yield from action._choices_actions

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            hint = meant(value, map(str, action.choices or ()))
            raise argparse.ArgumentError(action, f"{error.message}{hint}") from None

    def _get_value(self, action: argparse.Action, arg_string: str) -> Any:
        try:
            return super()._get_value(action, arg_string)
        except argparse.ArgumentError as error:
            if (expected := NUMBERS.get(action.type)) is None:
                raise
            text = f"expected {expected}, got {arg_string!r}; write one"
            raise argparse.ArgumentError(action, text) from error

    def parse_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """Parse the words of a command line. The parser of the verb reports unknown options."""
        options, unknown = self.parse_known_args(args, namespace)
        if unknown:
            verb = self.verbs[options.verb] if getattr(options, "verb", None) else self
            wrong = next((word for word in unknown if word.startswith("-")), unknown[0])
            flag = wrong.partition("=")[0]
            is_setting = (name := flag[2:].replace("-", "_")) in verb.settings
            hint = f"; write --set {name}=VALUE" if is_setting else meant(flag, verb.names)
            # The values of an argument that takes many are one after the other.
            takes_many = any(a.nargs in ("*", "+") for a in verb._get_positional_actions())
            if not wrong.startswith("-") and takes_many:
                hint = "; write them before the options"
            verb.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
        return options

    @property
    def verbs(self) -> Mapping[str, Parser]:
        """The parsers of the verbs, by name; empty for the parser of a verb."""
        groups = (a.choices for a in self._actions if isinstance(a, argparse._SubParsersAction))
        return next(groups, {})

    @property
    def names(self) -> list[str]:
        """The names of all options, such as "--json"."""
        return [name for action in self._actions for name in action.option_strings]

    def error(self, message: str) -> NoReturn:
        """Print the usage and a message, and exit with code 2."""
        super().error(printable(message))  # the message repeats what the user typed


class Verbs(argparse._SubParsersAction):  # type: ignore[type-arg]
    """The verbs of a program."""

    def add(
        self,
        name: str,
        run: Callable[[argparse.Namespace], int],
        said: str,
        description: str,
        epilog: str | None = None,
    ) -> Parser:
        """Add a verb and return its parser.

        Args:
            name: The name of the verb.
            run: Does what the options ask for, and returns the exit code.
            said: The text for the list of verbs.
            description: The text at the top of the help of this verb.
            epilog: The text at its end.
        """
        parser: Parser = self.add_parser(name, help=said, description=description, epilog=epilog)
        parser.set_defaults(run=run)
        return parser
