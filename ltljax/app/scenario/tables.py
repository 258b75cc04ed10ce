"""Reads the tables of a scenario file. Errors name the file, the key, what was expected and what was found."""

import math
import re
import tomllib
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

from .formulas import Formula, FormulaError, parse
from .wording import cut, did_you_mean, listed

# Far more than any scenario needs.
_LARGEST_FILE = 1_000_000
_DEEPEST = 8
# The TOML parser takes time quadratic in the number of parts of a key, so long keys are refused before it runs.
_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![\w-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{4 * _DEEPEST}}}")
# Longer keys are cut in messages.
_LONGEST_NAME = 40


class ScenarioError(ValueError):
    """A scenario file with a mistake."""


def read_text(path: Path) -> str:
    """The text of a scenario file.

    Raises:
        ScenarioError: the path is not a regular file, or the file is too long or not in UTF-8.
        OSError: the file cannot be read.
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
        byte = f"the byte 0x{data[error.start]:02x} in line {line}"
        raise ScenarioError(f"{path}: expected text in UTF-8, found {byte}. Save the file as UTF-8.") from None


def load(text: str, name: str) -> dict[str, Any]:
    """The tables of a TOML text.

    Raises:
        ScenarioError: the text is too long, nests too deeply, or is not TOML.
    """
    if len(text) > _LARGEST_FILE:
        raise ScenarioError(f"{name}: expected at most {_LARGEST_FILE} characters, found {len(text)}.")
    if long_key := _LONG_KEY.search(text):
        line = text.count("\n", 0, long_key.start()) + 1
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
    """One table of a scenario file. Values are taken from it by name, and a value that nobody takes is a mistake.

    Args:
        values: the table.
        file: name of the file, for messages.
        path: dotted name of the table, for messages.

    Attributes:
        taken: the values taken so far, defaults included.
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
        """The keys that have not been taken yet."""
        return [key for key in self._values if key not in self.taken]

    def name(self, key: str) -> str:
        """A key with those of the tables around it, such as ``kinetics.feed``; cut if it is very long."""
        short = cut(key, _LONGEST_NAME)
        return f"{self._path}.{short}" if self._path else short

    def error(self, key: str, expected: str) -> ScenarioError:
        """The error for a key whose value is not what was expected."""
        return ScenarioError(
            f"{self._file}: expected {expected} as {self.name(key)}, found {_shown(self._values.get(key))}."
        )

    def refused(self, key: str, reason: object) -> ScenarioError:
        """The error for a key whose value is refused for a reason that stands for itself."""
        return ScenarioError(f"{self._file}: {self.name(key)}: {reason}")

    def table(self, key: str) -> "Table":
        """A table inside this one; an empty table if there is none."""
        inner = Table(self._values.get(key, {}), self._file, self.name(key))
        self.taken[key] = inner.taken
        return inner

    def tables(self, key: str) -> list["Table"]:
        """The tables of a list of tables; empty by default."""
        value = self._values.get(key, [])
        if not isinstance(value, list):
            raise self.error(key, f"a list of tables, [[{self.name(key)}]],")
        inner = [Table(entry, self._file, self.name(key)) for entry in value]
        self.taken[key] = [table.taken for table in inner]
        return inner

    def number(
        self, key: str, default: float | int, least: float | int = -math.inf, most: float | int = math.inf
    ) -> float:
        """A finite number within bounds."""
        value = self._values.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not _is_within(value, least, most):
            if 0 < least < 1e-200:  # a bound that means "positive"
                bounds = " above 0"
            elif math.isfinite(least + most):
                bounds = f" from {least:g} to {most:g}"
            else:
                bounds = f" of at least {least:g}" if math.isfinite(least) else ""
            raise self.error(key, f"a number{bounds}")
        return self._take(key, float(value))

    def count(self, key: str, default: int, least: int, most: int) -> int:
        """A whole number within bounds."""
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
        """A text of one line."""
        value = self._values.get(key, default)
        if not isinstance(value, str) or len(value) > 1000 or not value.isprintable():
            raise self.error(key, "a text")
        return self._take(key, value)

    def texts(self, key: str) -> list[str]:
        """A list of texts; empty by default."""
        value = self._values.get(key, [])
        if not isinstance(value, list) or not all(isinstance(entry, str) for entry in value):
            raise self.error(key, "a list of texts")
        return self._take(key, value)

    def peek(self, key: str) -> Any:
        """The value of a key, unchecked and not taken; None if there is none."""
        return self._values.get(key)

    def choice(self, key: str, allowed: Collection[str], default: str | None = None) -> str:
        """One of several words."""
        value = self._values.get(key, default)
        if not isinstance(value, str) or value not in allowed:
            raise self.error(key, f"one of {listed(allowed)}{did_you_mean(value, allowed)}")
        return self._take(key, value)

    def formula(self, key: str, names: Iterable[str], default: float | int | str | None = None) -> Formula:
        """A number or a formula in some names."""
        value = self._values.get(key, default)
        is_number = isinstance(value, int | float) and not isinstance(value, bool) and _is_within(value)
        if not (is_number or isinstance(value, str)):
            raise self.error(key, "a number or a formula")
        try:
            formula = parse(repr(float(value)) if is_number else value, names)  # type: ignore
        except FormulaError as error:
            raise self.refused(key, error) from None
        self._take(key, value)
        return formula

    def formulas(self, key: str, count: int, names: Iterable[str]) -> list[Formula]:
        """A list of ``count`` numbers or formulas."""
        value = self._values.get(key)
        if not isinstance(value, list) or len(value) != count:
            raise self.error(key, f"a list of {count} formulas")
        inner = Table({str(index): entry for index, entry in enumerate(value)}, self._file, self.name(key))
        formulas = [inner.formula(str(index), names) for index in range(count)]
        self._take(key, value)
        return formulas

    def numbers(self, key: str, default: tuple[float | int, ...], least: float | int, most: float | int) -> list[float]:
        """A list of as many numbers as the default has."""
        value = self._values.get(key, list(default))
        if not isinstance(value, list) or len(value) != len(default):
            raise self.error(key, f"a list of {len(default)} numbers")
        inner = Table({str(index): entry for index, entry in enumerate(value)}, self._file, self.name(key))
        return self._take(key, [inner.number(str(index), 0.0, least, most) for index in range(len(default))])

    def file(self, key: str, folder: Path) -> Path:
        """A file in the folder of the scenario, or below it.

        Raises:
            ScenarioError: the path leads out of the folder, or there is no such file.
        """
        value = self.text(key)
        inside = folder.resolve()
        try:
            path = (inside / value).resolve()
            is_file = path.is_file()
        except (OSError, ValueError, RuntimeError):
            raise self.error(key, "the name of a file") from None
        if not path.is_relative_to(inside):
            other = "; give a mesh from elsewhere by --mesh" if self.name(key) == "mesh.file" else ""
            raise self.error(key, f"a file in the scenario's own folder, {folder}, or below it{other}")
        if not is_file:
            raise self.error(key, "the name of a file that exists")
        return path

    def finish(self) -> None:
        """Raise if a key was not taken, since it would silently do nothing."""
        for key in self.names():
            allowed = sorted(self.taken)
            raise ScenarioError(
                f"{self._file}: {self.name(key)} is not known{did_you_mean(key, allowed)}. "
                f"Known here: {listed(allowed)}."
            )

    def _take(self, key: str, value: Any) -> Any:
        self.taken[key] = value
        return value


def _is_within(value: float | int, least: float | int = -math.inf, most: float | int = math.inf) -> bool:
    try:
        number = float(value)
    except OverflowError:
        return False
    return math.isfinite(number) and least <= number <= most


def _shown(value: Any) -> str:
    try:
        text = "nothing" if value is None else repr(value)
    except (ValueError, RecursionError):  # an integer with more digits than Python prints
        text = f"a very large {type(value).__name__}"
    return cut(text, 80)
