"""Parse the command line, with groups of verbs, settings, and hints for misspelt names.

Each verb is a function with rows, one for each argument and option, in a section of options.txt.
Its docstring is the help text.
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import inspect
import math
import re
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NoReturn, TypeAlias

from ssh_abduction.data.errors import printable
from ssh_abduction.data.words import meant

# The help text of each argument, by its form, such as "-n --maps K=100" (see `Parser.add_rows`).
# A tuple adds further arguments of argparse's `add_argument`, by name.
Rows: TypeAlias = Mapping[str, str | tuple[str, Mapping[str, Any]]]

NUMBERS: dict[Any, str] = {int: "a whole number", float: "a number"}

OPTIONS = Path(__file__).with_name("options.txt")
# The names of the files in a folder that map wrote.
MAPS, TRACE, RUN = "maps.json", "trace.jsonl", "run.json"
LIVE = "drive.names"  # what a folder of live has instead of RUN


def true_or_false(text: str) -> bool:
    """Convert "true" or "false" to a bool. Raise ArgumentTypeError for anything else."""
    if text not in ("true", "false"):
        raise argparse.ArgumentTypeError(f"expected true or false, got {text!r}; write one of them")
    return text == "true"


def output(text: str) -> str:
    """Return the name of a file or folder to write. Raise ArgumentTypeError if it is none."""
    if not text or "\0" in text:
        raise argparse.ArgumentTypeError(
            f"expected the name of a file or folder, got {text!r}; name one"
        )
    return text


def seed(text: str) -> int:
    """Convert text to a seed of random numbers. Raise ArgumentTypeError for anything else."""
    if not text.isdecimal() or int(text) >= 2**32:
        raise argparse.ArgumentTypeError(
            f"expected a whole number from 0 to {2**32 - 1}, got {text!r}; give one"
        )
    return int(text)


def pose(text: str) -> tuple[float, float, float]:
    """Convert "X,Y,DEGREES" to numbers. Raise ArgumentTypeError for anything else."""
    with contextlib.suppress(ValueError):
        x, y, degrees = map(float, text.split(","))
        if all(map(math.isfinite, (x, y, degrees))):
            return x, y, degrees
    raise argparse.ArgumentTypeError(
        f"expected X,Y,DEGREES, three numbers such as 1.5,-2,90, got {text!r}; write them"
    )


def picture_file(text: str) -> str:
    """Return the name of a file for a figure. Raise ArgumentTypeError for a wrong ending."""
    if Path(text).suffix.lower() not in (".png", ".pdf", ".svg"):
        raise argparse.ArgumentTypeError(
            f"expected a name that ends in .png, .pdf or .svg, got {text!r}"
            "; add one of these endings"
        )
    return text


def maps_path(text: str) -> str:
    """Return the file of maps that an argument names. If it names a folder, add maps.json."""
    return str(Path(text) / MAPS) if Path(text).is_dir() else text


def trace_path(text: str) -> str:
    """Return the trace file that an argument names. If it names a folder, add trace.jsonl."""
    return str(Path(text) / TRACE) if Path(text).is_dir() else text


# What converts the text of a value, by the word for the value. OUTPUT is for the option --output.
OUTPUT = "--output"
TYPES: Mapping[str, Callable[[str], Any]] = {
    OUTPUT: output,
    "true|false": true_or_false,
    **dict.fromkeys(("N", "K", "MIB"), int),
    **dict.fromkeys(("S", "W", "P", "METRES", "SHARE", "DEGREES", "NUMBER"), float),
    "SEED": seed,
    "PNG": picture_file,
    **dict.fromkeys(("maps", "MAPS"), maps_path),
    **dict.fromkeys(("trace", "TRACE"), trace_path),
}


@dataclass(frozen=True)
class Verb:
    """A verb of the program: the function `run_NAME`, whose docstring is the help of the verb."""

    run: Callable[[argparse.Namespace], int]  # does what the options ask for; returns the exit code
    rows: Rows  # the arguments and options

    @property
    def name(self) -> str:
        """The name of the verb, such as "export"."""
        return self.run.__name__.removeprefix("run_").replace("_", "-")

    @property
    def help(self) -> str:
        """The text at the top of the help: paragraphs, of which the first is a summary."""
        return inspect.cleandoc(self.run.__doc__ or "")

    @property
    def summary(self) -> str:
        """The line in the list of verbs."""
        first = self.help.partition("\n\n")[0]
        return (first[:1].lower() + first[1:]).removesuffix(".")


def verb(
    details: Mapping[str, Mapping[str, Any]] | None = None, **more: Rows
) -> Callable[[Callable[[argparse.Namespace], int]], Verb]:
    """Make a verb of the function `run_NAME`, with the rows of the section NAME, as `rows_of`."""
    return lambda run: Verb(run, rows_of(run.__name__.removeprefix("run_"), details, **more))


def rows_of(
    section: str, details: Mapping[str, Mapping[str, Any]] | None = None, **more: Rows
) -> Rows:
    """Read the rows of a section of options.txt.

    Below the form of a row is its help text, indented. A line $NAME stands for the rows `more` of
    this name, or else for those of the section NAME. `details` has arguments of `add_argument` for
    some rows, by the first word of the form, without --set.
    """
    found: dict[str, str | tuple[str, Mapping[str, Any]]] = {}
    for form, text in _sections().get(section, ()):
        found |= (more.get(form[1:]) or rows_of(form[1:])) if form[0] == "$" else {form: text}
    for form, said in found.items():
        name = form.removeprefix("--set ").split()[0].strip("[]")
        if details and name in details and isinstance(said, str):
            found[form] = said, details[name]
    return found


@cache
def _sections() -> dict[str, list[tuple[str, str]]]:
    """Read the sections of options.txt: pairs of a form and a text, by the name of the section."""
    found: dict[str, list[tuple[str, str]]] = {}
    rows: list[tuple[str, str]] = []
    for line in OPTIONS.read_text(encoding="utf-8").splitlines():
        if line.startswith("== "):
            rows = found.setdefault(line[3:], [])
        elif line.startswith(" "):
            form, text = rows.pop()
            rows.append((form, f"{text} {line.strip()}".lstrip()))
        elif line:
            rows.append((line, ""))
    return found


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
            hint = f"; write {name}=VALUE" if setting else parser.meant(f"--{name}")
            raise argparse.ArgumentError(
                self, f"expected NAME=VALUE with a name out of {known}, got {values!r}{hint}"
            )
        if text == "--":
            raise argparse.ArgumentError(self, f"{setting.dest}: expected a value, got '--'")
        try:
            value = parser._get_value(setting, text)
            parser._check_value(setting, value)
        except argparse.ArgumentError as error:
            raise argparse.ArgumentError(self, f"{setting.dest}: {error.message}") from None
        setting(parser, namespace, value)


class _Paragraphs(argparse.HelpFormatter):
    """Keeps the paragraphs of long texts apart, and lists no verbs beside the word VERB."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        fill = super()._fill_text
        return "\n\n".join(fill(part, width, indent) for part in text.split("\n\n"))

    def _iter_indented_subactions(self, action: argparse.Action) -> Generator[argparse.Action]:
        yield from ()  # the verbs are listed in groups


class Parser(argparse.ArgumentParser):
    """An argparse parser with settings, and hints for misspelt names."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.settings: dict[str, argparse.Action] = {}  # of this verb, by name
        self.formatter_class = _Paragraphs
        self._listed = argparse._ArgumentGroup(self, "settings, each given as --set NAME=VALUE")

    def add_rows(self, rows: Rows) -> None:
        """Add an argument, an option, a setting or a group for each row.

        These are the forms of the rows:

        - "maps", "[trace]": an argument, and one that may be left out. "traces trace..." is the
          argument `traces`, which takes one or more values, each called trace in the help.
        - "--json": a flag.
        - "-n --maps K=100": an option with a value, called K in the help, and its default. "K!"
          means that the option is required, and "X..." that it takes several values. "--by {a,b}"
          lists all values that are allowed.
        - "--set within K=0": the setting `within`, which the user gives as --set within=VALUE.
        - "# theory": a group for the options that follow.
        """
        group: argparse._ActionsContainer = self
        for form, told in rows.items():
            said, more = (told, {}) if isinstance(told, str) else told
            words, _, default = form.partition("=")
            shown = f"{said} (default: {default})" if default else said
            if form.startswith("# "):
                group = self.add_argument_group(form[2:], said)
            elif form.startswith("--set "):
                (name,), details = _read_form(words[6:])
                self._add_setting(
                    name, {"help": shown, "default": default or None, **details, **more}
                )
            else:
                names, details = _read_form(words)
                given = {"default": default} if default else {}
                group.add_argument(*names, help=shown, **{**details, **given, **more})

    def _add_setting(self, name: str, details: dict[str, Any]) -> None:
        if not self.settings:
            shown = "change one of the settings that are listed below; may be given again"
            self.add_argument(
                "--set", help=shown, action=_Set, dest=argparse.SUPPRESS, metavar="NAME=VALUE"
            )
            self._action_groups.append(self._listed)
        many, choices = details.pop("nargs", None), details.get("choices")
        value = f"{{{','.join(choices)}}}" if choices else details["metavar"]
        kind = argparse._AppendAction if many else argparse._StoreAction
        setting = kind([], name, **{**details, "metavar": f"{name}={value}"})
        self.settings[name] = setting
        self._listed._group_actions.append(setting)  # for the help: the parser has no such option
        default = setting.default and self._get_value(setting, setting.default)
        self.set_defaults(**{name: default})

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            names = [*map(str, action.choices)]
            expected = " or ".join(filter(None, (", ".join(names[:-1]), names[-1])))
            hint = meant(value, names)
            raise argparse.ArgumentError(action, f"expected {expected}, got {value!r}{hint}")

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
            hint = f"; write --set {name}=VALUE" if is_setting else verb.meant(flag)
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

    def meant(self, flag: str) -> str:
        """Make a hint for a misspelt option such as "--widht": a similar option or setting."""
        shown = {f"--{name.replace('_', '-')}": f"--set {name}=VALUE" for name in self.settings}
        shown |= {name: name for name in self.names}
        flag = flag.replace("_", "-")
        near = [name for name in shown if name.startswith(flag)]
        near += difflib.get_close_matches(flag, {*shown} - {"--help"}, n=1)
        return f"; did you mean {shown[near[0]]}?" if near else ""

    def error(self, message: str) -> NoReturn:
        """Print a message, which repeats what the user typed, and exit with code 2."""
        self.exit(2, f"{self.prog}: error: {printable(message)} (options: {self.prog} --help)\n")


def _read_form(form: str) -> tuple[list[str], dict[str, Any]]:
    """Read the form of a row, without its default: return its names, and details for argparse."""
    words = form.strip("[]").split()
    count = sum(word.startswith("-") for word in words) or 1  # of names, before the values
    names, values = words[:count], words[count:]
    is_option, details = names[0].startswith("-"), dict[str, Any]()
    values = values or ([] if is_option else names)
    if not values:
        return names, {"action": "store_true"}
    metavars = tuple(re.sub(r"\.\.\.$|!$", "", value) for value in values)
    if metavars[0].startswith("{"):
        details["choices"] = metavars[0][1:-1].split(",")
    else:
        details["metavar"] = metavars if metavars[1:] else metavars[0]
    if kind := TYPES.get(OUTPUT if names[-1] == OUTPUT else metavars[0]):
        details["type"] = kind
    if metavars[1:]:
        details["nargs"] = len(metavars)
    elif values[0].endswith("..."):
        details["nargs"] = "*" if form.startswith("[") else "+"
        if is_option:
            details["action"] = "extend"
    elif form.startswith("["):
        details["nargs"] = "?"
    if values[0].endswith("!"):
        details["required"] = True
    return names, details
