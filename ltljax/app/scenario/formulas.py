"""Formulas that people write into files, as ``"a - u + u^2*v"``: arithmetic that is parsed, never executed as code.

What enters: a text and the names it may use. What leaves: a `Formula`, which computes with jax.numpy. There are
numbers, names, operators and the functions of one table, and nothing else: no attributes, no indexing, no other calls.
Numbers are floating point from the start, so no power grows without bound. Length and depth are limited.
"""

import dataclasses
import difflib
import math
import re
from collections.abc import Callable, Iterable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

_LONGEST = 2000
_DEEPEST = 60
_CONSTANTS = {"pi": math.pi, "e": math.e}
# Integer powers up to this are products, whose derivatives are right at zero and for negative bases.
_LARGEST_POWER = 64


class FormulaError(ValueError):
    """A formula that cannot be read: the message names it, the column, what was found and what is allowed."""


def _both(compare: Callable) -> Callable:
    return lambda a, b: jnp.where(compare(a, b), 1.0, 0.0)


def _smoothstep(low, high, x):
    s = jnp.clip((x - low) / (high - low), 0.0, 1.0)
    return s * s * (3 - 2 * s)


# Each function by name, and how many arguments it takes.
_FUNCTIONS: dict[str, tuple[int, Callable[..., Any]]] = {
    **{name: (1, getattr(jnp, name)) for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "sqrt")},
    **{name: (1, getattr(jnp, name)) for name in ("abs", "sign", "floor")},
    "asin": (1, jnp.arcsin),
    "acos": (1, jnp.arccos),
    "atan": (1, jnp.arctan),
    "atan2": (2, jnp.arctan2),
    "hypot": (2, jnp.hypot),
    "min": (2, jnp.minimum),
    "max": (2, jnp.maximum),
    "mod": (2, jnp.mod),
    "step": (1, lambda x: jnp.where(x > 0, 1.0, 0.0)),
    "where": (3, lambda condition, a, b: jnp.where(condition != 0, a, b)),
    "clip": (3, jnp.clip),
    "smoothstep": (3, _smoothstep),
}
_BINARY: dict[str, Callable[..., Any]] = {
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "/": lambda a, b: a / b,
    "^": jnp.power,
    "<": _both(lambda a, b: a < b),
    "<=": _both(lambda a, b: a <= b),
    ">": _both(lambda a, b: a > b),
    ">=": _both(lambda a, b: a >= b),
    "==": _both(lambda a, b: a == b),
    "!=": _both(lambda a, b: a != b),
    "and": _both(lambda a, b: (a != 0) & (b != 0)),
    "or": _both(lambda a, b: (a != 0) | (b != 0)),
}
# What a step of a formula does, by name, and how many of the last values it takes.
_STEPS: dict[str, tuple[int, Callable[..., Any]]] = {
    **_FUNCTIONS,
    **{sign: (2, function) for sign, function in _BINARY.items()},
    "negative": (1, lambda a: -a),
    "not": (1, lambda a: jnp.where(a == 0, 1.0, 0.0)),
}
# How strongly each operator binds; comparisons do not chain, powers bind to the right.
_BINDING = {"or": 1, "and": 2, "+": 5, "-": 5, "*": 6, "/": 6, "^": 8}
_BINDING |= dict.fromkeys(("<", "<=", ">", ">=", "==", "!="), 4)
_NOT, _NEGATIVE, _COMPARISON = 3, 7, 4
_TOKEN = re.compile(
    r"[ \t]*(?:(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)|(?P<name>[A-Za-z_][A-Za-z0-9_]*)"
    r"|(?P<sign>\*\*|<=|>=|==|!=|[-+*/^(),<>]))"
)


@dataclasses.dataclass(frozen=True)
class Formula:
    """A formula, ready to be evaluated; equal formulas are equal and hash alike.

    Attributes:
        text: as it was written.
        steps: in the order in which they are done: a number or ("name", its name), whose value is kept; ("power", n);
            or the name of what to do with the last values.
        names: the names it uses, in alphabetical order.
    """

    text: str = dataclasses.field(compare=False)
    steps: tuple[Any, ...]
    names: tuple[str, ...]

    def __call__(self, /, **values: Array | float) -> Array:
        """The value, for a number or an array of each name; arrays are combined as NumPy does."""
        kept: list[Array] = []
        for step in self.steps:
            match step:
                case float():
                    # Weakly typed: a number takes the float type of what it meets.
                    kept.append(jnp.asarray(step))
                case ("name", name):
                    kept.append(jnp.asarray(values[name]))
                case ("power", exponent):
                    kept.append(kept.pop() ** exponent)
                case _:
                    count, function = _STEPS[step]
                    kept[-count:] = [function(*kept[-count:])]
        return kept[0]

    def __str__(self) -> str:
        return self.text


def parse(text: str, names: Iterable[str] = ()) -> Formula:
    """The formula of a text.

    Operators: ``+ - * / ^`` (also ``**``; to the right, and stronger than a sign), ``< <= > >= == !=`` (1 or 0),
    ``and or not``. Constants: pi, e. Functions: `functions`.

    Args:
        text: the formula.
        names: those it may use.

    Raises:
        FormulaError: it is none.
    """
    reader = _Reader(text, tuple(names))
    reader.expression(0, 0)
    if reader.kind != "end":
        raise reader.error("an operator or the end")
    used = {step[1] for step in reader.steps if isinstance(step, tuple) and step[0] == "name"}
    return Formula(text, tuple(reader.steps), tuple(sorted(used)))


def functions() -> tuple[str, ...]:
    """The names of the functions that formulas know."""
    return tuple(sorted(_FUNCTIONS))


class _Reader:
    """Precedence climbing: an operator takes what stands at its left, and as much of what follows as binds stronger."""

    def __init__(self, text: str, names: tuple[str, ...]):
        self.text, self.known, self.end = text, names, 0
        self.steps: list[Any] = []
        if len(text) > _LONGEST:
            raise FormulaError(f"Expected a formula of at most {_LONGEST} characters, found {len(text)}.")
        self.next()

    def next(self) -> None:
        """Read one token; ``start`` is where it begins."""
        rest = self.text[self.end :]
        found = _TOKEN.match(self.text, self.end)
        if found is None and rest.strip(" \t"):
            self.start = self.end + len(rest) - len(rest.lstrip(" \t"))
            self.kind, self.word = "unknown", self.text[self.start]
            raise self.error("a number, a name, an operator or a parenthesis")
        if found is None:
            self.kind, self.word, self.start = "end", "", len(self.text)
            return
        self.kind, self.word = str(found.lastgroup), found[str(found.lastgroup)]
        self.start, self.end = found.start(self.kind), found.end()
        if self.word in ("and", "or", "not"):
            self.kind = "sign"
        self.word = "^" if self.word == "**" else self.word

    def error(self, expected: str) -> FormulaError:
        """The mistake at the token that was read last."""
        found = "the end" if self.kind == "end" else repr(cut(self.word, 40))
        return FormulaError(f'"{cut(self.text, 80)}", column {self.start + 1}: expected {expected}, found {found}.')

    def expression(self, weakest: int, depth: int) -> None:
        """Read operators that bind more strongly than the weakest, and what they join."""
        if depth > _DEEPEST:
            raise self.error(f"at most {_DEEPEST} levels of parentheses and signs")
        self.operand(depth)
        while self.kind == "sign" and _BINDING.get(self.word, 0) > weakest:
            operator, binding = self.word, _BINDING[self.word]
            self.next()
            self.expression(binding - (operator == "^"), depth + 1)
            last = self.steps[-1]
            if operator == "^" and isinstance(last, float) and abs(last) <= _LARGEST_POWER and last == int(last):
                self.steps[-1] = ("power", int(last))
            else:
                self.steps.append(operator)
            if binding == _COMPARISON and _BINDING.get(self.word) == _COMPARISON:
                raise self.error("'and' between two comparisons")

    def operand(self, depth: int) -> None:
        """Read a number, a name, a call, something in parentheses, or something with a sign."""
        kind, word = self.kind, self.word
        if kind == "number":
            if math.isinf(float(word)):
                raise self.error("a number of at most 1e308")
            self.steps.append(float(word))
            self.next()
        elif kind == "name":
            self.name(depth)
        elif kind == "sign" and word in ("-", "+", "not"):
            self.next()
            self.expression(_NOT if word == "not" else _NEGATIVE, depth + 1)
            if word == "-" and isinstance(self.steps[-1], float):
                self.steps[-1] = -self.steps[-1]
            elif word != "+":
                self.steps.append("negative" if word == "-" else "not")
        elif kind == "sign" and word == "(":
            self.next()
            self.expression(0, depth + 1)
            self.close("an operator or ')'")
        else:
            raise self.error("a number, a name or '('")

    def name(self, depth: int) -> None:
        """Read a name: one that is known, a constant, or a function with its arguments."""
        word, is_call = self.word, self.text[self.end :].lstrip(" \t").startswith("(")
        if is_call and word not in _FUNCTIONS:
            raise self.error(f"a function ({', '.join(functions())}){_near(word, _FUNCTIONS)}")
        if is_call:
            self.next()
            self.call(word, depth)
            return
        if word in self.known:
            self.steps.append(("name", word))
        elif word in _CONSTANTS:
            self.steps.append(_CONSTANTS[word])
        else:
            allowed = (*self.known, *_CONSTANTS)
            raise self.error(f"one of {cut(', '.join(allowed), 400)}{_near(word, (*allowed, *_FUNCTIONS))}")
        self.next()

    def call(self, word: str, depth: int) -> None:
        """Read the arguments of a function."""
        count, _ = _FUNCTIONS[word]
        taken = f"{count} argument{'s' * (count > 1)} of {word}"
        self.next()
        for left in reversed(range(count)):
            self.expression(0, depth + 1)
            self.close(f"',' between the {taken}" if left else f"')' after the {taken}", "," if left else ")")
        self.steps.append(word)

    def close(self, expected: str, sign: str = ")") -> None:
        """Go past a sign that must stand here."""
        if self.kind != "sign" or self.word != sign:
            raise self.error(expected)
        self.next()


def cut(text: str, most: int) -> str:
    """A text as messages show it: its beginning, where it is long."""
    return text if len(text) <= most else text[: most - 3] + "..."


def _near(word: str, allowed: Iterable[str]) -> str:
    near = difflib.get_close_matches(word[:100], list(allowed), n=1)
    return f" (did you mean {cut(near[0], 40)}?)" if near else ""
