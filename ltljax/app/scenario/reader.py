"""Reads tables of a scenario file: a mistake is named by file, key, what was found and what is allowed."""

import difflib
import math
import re
import tomllib
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

from .formulas import Formula, FormulaError, cut, parse

# More than any scenario needs; what is larger is not one.
_LARGEST_FILE = 1_000_000
_DEEPEST = 8
# A key of many parts takes the parser time in proportion to the square of their number, whose depth is seen only after.
_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![\w-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{4 * _DEEPEST}}}")
# Longer names and lists of names are not spelled out in messages.
_LONGEST_NAME, _LONGEST_LIST = 40, 400


class ScenarioError(ValueError):
    """A scenario file that does not say what to do."""


def read_text(path: Path) -> str:
    """The text of a scenario file.

    Raises:
        ScenarioError: it is no regular file, too long, or not in UTF-8.
        OSError: it cannot be read.
    """
    if path.exists() and not path.is_file():
        raise ScenarioError(f"{path}: expected a file, found a folder or a device.")
    with open(path, "rb") as file:
        data = file.read(4 * _LARGEST_FILE + 1)
    if len(data) > 4 * _LARGEST_FILE:
        raise ScenarioError(f"{path}: expected at most {_LARGEST_FILE} characters, found more.")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        found = f"the byte 0x{data[error.start]:02x} in line {line}"
        raise ScenarioError(f"{path}: expected text in UTF-8, found {found}. Save it as UTF-8.") from None


def load(text: str, name: str) -> dict[str, Any]:
    """The tables of a TOML text.

    Raises:
        ScenarioError: it is too long, or no TOML.
    """
    if len(text) > _LARGEST_FILE:
        raise ScenarioError(f"{name}: expected at most {_LARGEST_FILE} characters, found {len(text)}.")
    if found := _LONG_KEY.search(text):
        line = text.count("\n", 0, found.start()) + 1
        raise ScenarioError(f"{name}: expected keys of at most {_DEEPEST} parts, found more in line {line}.")
    try:
        tables = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        raise ScenarioError(f"{name}: expected TOML, found: {error or 'tables too deep'}.") from None
    if _depth(tables) > _DEEPEST:
        raise ScenarioError(f"{name}: expected tables at most {_DEEPEST} deep.")
    return tables


def _depth(value: Any, limit: int = _DEEPEST) -> int:
    if limit < 0 or not isinstance(value, dict | list) or not value:
        return 0
    return 1 + max(_depth(inner, limit - 1) for inner in (value.values() if isinstance(value, dict) else value))


class Table:
    """One table of a scenario file, from which values are taken by name; what is not taken is a mistake.

    Args:
        values: the table.
        file: the name of the file, for messages.
        path: the table's own name, for messages.
    """

    def __init__(self, values: Any, file: str, path: str = ""):
        self._file, self._path = file, path
        if not isinstance(values, dict):
            raise ScenarioError(f"{file}: expected [{path}] as a table, found {_shown(values)}.")
        self._values: dict[str, Any] = values
        self.taken: dict[str, Any] = {}

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def names(self) -> list[str]:
        """The keys that are left."""
        return [key for key in self._values if key not in self.taken]

    def error(self, key: str, expected: str) -> ScenarioError:
        """The mistake that the value of a key is."""
        return ScenarioError(
            f"{self._file}: expected {expected} as {self.name(key)}, found {_shown(self._values.get(key))}."
        )

    def refused(self, key: str, reason: object) -> ScenarioError:
        """The mistake that the value of a key is, as another room has put it."""
        return ScenarioError(f"{self._file}: {self.name(key)}: {reason}")

    def table(self, key: str) -> "Table":
        """A table inside; empty where there is none."""
        inner = Table(self._values.get(key, {}), self._file, self.name(key))
        self.taken[key] = inner.taken
        return inner

    def tables(self, key: str) -> list["Table"]:
        """The tables of a list of tables; none by default."""
        value = self._values.get(key, [])
        if not isinstance(value, list):
            raise self.error(key, f"a list of tables, [[{self.name(key)}]],")
        inner = [Table(entry, self._file, self.name(key)) for entry in value]
        self.taken[key] = [one.taken for one in inner]
        return inner

    def number(self, key: str, default: float, least: float = -math.inf, most: float = math.inf) -> float:
        """A finite number."""
        value = self._values.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not _is_within(value, least, most):
            bounds = f" from {least:g} to {most:g}" if math.isfinite(least + most) else ""
            bounds = bounds or (f" of at least {least:g}" if math.isfinite(least) else "")
            # The least number that is not lost counts as zero.
            bounds = bounds if not 0 < least < 1e-200 else " above 0"
            raise self.error(key, f"a number{bounds}")
        return self._take(key, float(value))

    def count(self, key: str, default: int, least: int, most: int) -> int:
        """A whole number."""
        value = self._values.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
            raise self.error(key, f"a whole number from {least} to {most}")
        return self._take(key, value)

    def flag(self, key: str, default: bool) -> bool:
        """True or false."""
        value = self._values.get(key, default)
        if not isinstance(value, bool):
            raise self.error(key, "true or false")
        return self._take(key, value)

    def text(self, key: str, default: str | None = None) -> str:
        """A text on one line."""
        value = self._values.get(key, default)
        if not isinstance(value, str) or len(value) > 1000 or not value.isprintable():
            raise self.error(key, "a text")
        return self._take(key, value)

    def peek(self, key: str) -> Any:
        """What a key holds, unchecked and not counted as used; None where there is none."""
        return self._values.get(key)

    def choice(self, key: str, allowed: Collection[str], default: str | None = None) -> str:
        """One of several words."""
        value = self._values.get(key, default)
        if not isinstance(value, str) or value not in allowed:
            raise self.error(key, f"one of {listed(allowed)}{_near(value, allowed)}")
        return self._take(key, value)

    def formula(self, key: str, names: Iterable[str], default: float | str | None = None) -> Formula:
        """A number or a formula of the names."""
        value = self._values.get(key, default)
        is_number = isinstance(value, int | float) and not isinstance(value, bool) and _is_within(value)
        if not (is_number or isinstance(value, str)):
            raise self.error(key, "a number or a formula")
        try:
            found = parse(repr(float(value)) if is_number else value, names)  # type: ignore
        except FormulaError as error:
            raise self.refused(key, error) from None
        self._take(key, value)
        return found

    def formulas(self, key: str, count: int, names: Iterable[str]) -> list[Formula]:
        """A list of so many formulas."""
        value = self._values.get(key)
        if not isinstance(value, list) or len(value) != count:
            raise self.error(key, f"a list of {count} formulas")
        inner = Table({str(index): entry for index, entry in enumerate(value)}, self._file, self.name(key))
        found = [inner.formula(str(index), names) for index in range(count)]
        self._take(key, value)
        return found

    def numbers(self, key: str, default: tuple[float, ...], least: float, most: float) -> list[float]:
        """As many numbers as the default has."""
        value = self._values.get(key, list(default))
        if not isinstance(value, list) or len(value) != len(default):
            raise self.error(key, f"a list of {len(default)} numbers")
        inner = Table({str(index): entry for index, entry in enumerate(value)}, self._file, self.name(key))
        return self._take(key, [inner.number(str(index), 0.0, least, most) for index in range(len(default))])

    def texts(self, key: str) -> list[str]:
        """A list of texts; empty by default."""
        value = self._values.get(key, [])
        if not isinstance(value, list) or not all(isinstance(entry, str) for entry in value):
            raise self.error(key, "a list of texts")
        return self._take(key, value)

    def file(self, key: str, folder: Path) -> Path:
        """A file in the folder of the scenario, or below.

        Raises:
            ScenarioError: it leads out of that folder, or does not exist.
        """
        value = self.text(key)
        inside = folder.resolve()
        try:
            path = (inside / value).resolve()
            is_file = path.is_file()
        except (OSError, ValueError, RuntimeError):
            raise self.error(key, "the name of a file") from None
        if not path.is_relative_to(inside):
            other = "; from elsewhere name it by --mesh" if self.name(key) == "mesh.file" else ""
            raise self.error(key, f"a file in the scenario's own folder, {folder}, or below it{other}")
        if not is_file:
            raise self.error(key, "the name of a file that exists")
        return path

    def finish(self) -> None:
        """Raise where a key was not taken: nobody would notice that it does nothing."""
        for key in self.names():
            allowed = sorted(self.taken)
            raise ScenarioError(
                f"{self._file}: {self.name(key)} is not known{_near(key, allowed)}. Known here: {listed(allowed)}."
            )

    def _take(self, key: str, value: Any) -> Any:
        self.taken[key] = value
        return value

    def name(self, key: str) -> str:
        """A key with those of the tables around it, as ``kinetics.feed``; cut where it is very long."""
        short = cut(key, _LONGEST_NAME)
        return f"{self._path}.{short}" if self._path else short


def _is_within(value: float, least: float = -math.inf, most: float = math.inf) -> bool:
    try:
        number = float(value)
    except OverflowError:
        return False
    return math.isfinite(number) and least <= number <= most


def listed(names: Collection[str]) -> str:
    """Names with commas between, not all where they are many."""
    return cut(", ".join(names), _LONGEST_LIST) or "nothing"


def _shown(value: Any) -> str:
    try:
        text = "nothing" if value is None else repr(value)
    except (ValueError, RecursionError):  # a whole number of more digits than Python writes
        text = f"a very large {type(value).__name__}"
    return cut(text, 80)


def _near(value: Any, allowed: Iterable[str]) -> str:
    near = difflib.get_close_matches(str(value)[:100], list(allowed), n=1)
    return f" (did you mean {cut(near[0], 40)}?)" if near else ""
