"""Formulas in scenario files, such as ``"a - u + u^2*v"``: arithmetic that is parsed and never executed as code.

What enters: a text and the names it may use. What leaves: a `Formula`, which computes with jax.numpy.

The text is split into numbers, names and signs, and anything else is refused. Python's `ast` parses them, and only the
nodes of arithmetic, comparisons and calls of the functions below are accepted. Numbers are floating point from the
start, so no power grows without bound. Length and depth are limited.
"""

import ast
import dataclasses
import math
import re
from collections.abc import Callable, Iterable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from .wording import LONGEST_LIST, cut, did_you_mean

_LONGEST, _DEEPEST = 2000, 60
_CONSTANTS = {"pi": math.pi, "e": math.e}
# Integer exponents up to this become repeated products, whose derivatives are right at zero and for negative bases.
_LARGEST_POWER = 64
_OPERAND = "a number, a name or '('"
# What ends an operand's operators, outside and inside parentheses.
_END = ("the end", "')'")


class FormulaError(ValueError):
    """A text that is not a formula. The message gives the column, what was expected and what was found."""


def _truth(condition: Callable) -> Callable:
    return lambda *values: jnp.where(condition(*values), 1.0, 0.0)


def _smoothstep(low, high, x):
    s = jnp.clip((x - low) / (high - low), 0.0, 1.0)
    return s * s * (3 - 2 * s)


# The number of arguments and the implementation of every function.
_FUNCTIONS: dict[str, tuple[int, Callable[..., Any]]] = {
    **{name: (1, getattr(jnp, name)) for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "sqrt")},
    **{name: (1, getattr(jnp, name)) for name in ("abs", "sign", "floor")},
    "asin": (1, jnp.arcsin), "acos": (1, jnp.arccos), "atan": (1, jnp.arctan), "atan2": (2, jnp.arctan2),
    "hypot": (2, jnp.hypot), "min": (2, jnp.minimum), "max": (2, jnp.maximum), "mod": (2, jnp.mod),
    "step": (1, _truth(lambda x: x > 0)), "clip": (3, jnp.clip), "smoothstep": (3, _smoothstep),
    "where": (3, lambda condition, a, b: jnp.where(condition != 0, a, b)),
}  # fmt: skip
# The same for every operator, by its node type.
_OPERATORS: dict[type, tuple[int, Callable[..., Any]]] = {
    ast.Add: (2, lambda a, b: a + b), ast.Sub: (2, lambda a, b: a - b), ast.Mult: (2, lambda a, b: a * b),
    ast.Div: (2, lambda a, b: a / b), ast.Pow: (2, jnp.power), ast.USub: (1, lambda a: -a),
    ast.Lt: (2, _truth(lambda a, b: a < b)), ast.LtE: (2, _truth(lambda a, b: a <= b)),
    ast.Gt: (2, _truth(lambda a, b: a > b)), ast.GtE: (2, _truth(lambda a, b: a >= b)),
    ast.Eq: (2, _truth(lambda a, b: a == b)), ast.NotEq: (2, _truth(lambda a, b: a != b)),
    ast.And: (2, _truth(lambda a, b: (a != 0) & (b != 0))), ast.Or: (2, _truth(lambda a, b: (a != 0) | (b != 0))),
    ast.Not: (1, _truth(lambda a: a == 0)),
}  # fmt: skip
_TOKEN = re.compile(
    r"(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)|(?P<sign>(?:and|or|not)(?![A-Za-z0-9_])"
    r"|\*\*|<=|>=|==|!=|[-+*/^(),<>])|(?P<name>[A-Za-z_][A-Za-z0-9_]*)|(?P<unknown>[^ \t])"
)


@dataclasses.dataclass(frozen=True)
class Formula:
    """A formula that can be evaluated. Equal formulas compare equal and have the same hash.

    Attributes:
        text: the formula as it was written.
        steps: the formula in postfix order: a number; ("name", its name) for the value of a name; ("power", n) for an
            integer power; or the function or operator that is applied to the last values.
        names: the names it uses, in alphabetical order.
    """

    text: str = dataclasses.field(compare=False)
    steps: tuple[Any, ...]
    names: tuple[str, ...]

    def __call__(self, /, **values: Array | float) -> Array:
        """The value of the formula, given a number or an array for each name; arrays broadcast as in NumPy."""
        stack: list[Array] = []
        for step in self.steps:
            match step:
                case float():
                    # Weakly typed: a number takes the float type of the array it meets.
                    stack.append(jnp.asarray(step))
                case ("name", name):
                    stack.append(jnp.asarray(values[name]))
                case ("power", exponent):
                    stack.append(stack.pop() ** exponent)
                case _:
                    count, function = _FUNCTIONS[step] if isinstance(step, str) else _OPERATORS[step]
                    stack[-count:] = [function(*stack[-count:])]
        return stack[0]

    def __str__(self) -> str:
        return self.text


def parse(text: str, names: Iterable[str] = ()) -> Formula:
    """The formula that a text describes.

    Operators: ``+ - * / ^`` (also ``**``; right-associative and stronger than a sign), ``< <= > >= == !=`` (1 or 0),
    ``and or not``. Constants: pi, e. Functions: `functions`.

    Args:
        text: the formula.
        names: the names that it may use.

    Raises:
        FormulaError: the text is not a formula, is too long or too deep, or uses another name.
    """
    if len(text) > _LONGEST:
        raise FormulaError(f"Expected a formula of at most {_LONGEST} characters, found {len(text)}.")
    parser = _Parser(text, tuple(names))
    parser.visit(parser.tree(), 0)
    used = {step[1] for step in parser.steps if isinstance(step, tuple) and step[0] == "name"}
    return Formula(text, tuple(parser.steps), tuple(sorted(used)))


def functions() -> tuple[str, ...]:
    """The names of the functions that formulas know."""
    return tuple(sorted(_FUNCTIONS))


class _Parser:
    """Turns a text into postfix steps by way of Python's syntax tree."""

    def __init__(self, text: str, names: tuple[str, ...]):
        self.text, self.names = text, names
        self.tokens = list(_TOKEN.finditer(text))
        self.columns: list[int] = []
        self.steps: list[Any] = []

    def tree(self) -> ast.expr:
        """Python's syntax tree of the formula. Names become n0, n1, ..., since they may be keywords of Python."""
        source, depth, follows_operand = "", 0, False
        for index, token in enumerate(self.tokens):
            word, kind = token[0], str(token.lastgroup)
            self.check(index, depth, follows_operand)
            depth += (word == "(") - (word == ")")
            follows_operand = kind != "sign" or word == ")"
            self.columns.append(len(source))
            number = repr(float(word)) if kind == "number" else ""
            source += {"number": number, "name": f"n{index}", "sign": word.replace("^", "**")}[kind] + " "
        try:
            return ast.parse(source.strip(), mode="eval").body
        except SyntaxError:  # All other mistakes of syntax are found by `check`: the text ends too early.
            end = f"an operator or {_END[depth > 0]}"
            raise self.error(len(self.tokens), end if follows_operand else _OPERAND) from None
        except (RecursionError, MemoryError):
            raise self.too_deep(0) from None

    def check(self, index: int, depth: int, follows_operand: bool) -> None:
        """Raise if a token cannot follow those before it, at some depth of parentheses."""
        word, kind = self.tokens[index][0], self.tokens[index].lastgroup
        previous = self.tokens[index - 1] if index else None
        is_call = word == "(" and previous is not None and previous.lastgroup == "name"
        if kind == "unknown":
            raise self.error(index, "a number, a name, an operator or a parenthesis")
        if kind == "number" and math.isinf(float(word)):
            raise self.error(index, "a number of at most 1e308")
        if kind == "name" and not follows_operand:
            self.check_name(index)
        if word == "(" and depth >= _DEEPEST:
            raise self.too_deep(index)
        begins_operand = kind != "sign" or word in ("not", "(")
        if follows_operand and not is_call and (begins_operand or (word == ")" and not depth)):
            raise self.error(index, f"an operator or {_END[depth > 0]}")
        if word == "not" and previous is not None and previous[0] not in ("(", ",", "and", "or", "not"):
            raise self.error(index, "'(' before 'not'")
        if not follows_operand and kind == "sign" and word not in ("-", "+", "not", "("):
            raise self.error(index, _OPERAND)

    def check_name(self, index: int) -> None:
        """Raise if a name is neither known nor a constant, or is called and not a function."""
        word = self.tokens[index][0]
        if index + 1 < len(self.tokens) and self.tokens[index + 1][0] == "(":
            if word not in _FUNCTIONS:
                raise self.error(index, f"a function ({', '.join(functions())}){did_you_mean(word, _FUNCTIONS)}")
            return
        allowed = (*self.names, *_CONSTANTS)
        if word not in allowed:
            hint = did_you_mean(word, (*allowed, *_FUNCTIONS))
            raise self.error(index, f"one of {cut(', '.join(allowed), LONGEST_LIST)}{hint}")

    def visit(self, node: Any, depth: int) -> None:
        """Append the steps of a node."""
        if depth > _DEEPEST:
            raise self.too_deep(self.token_at(node.col_offset))
        match node:
            case ast.Constant(value=float(value)):
                self.steps.append(value)
            case ast.Name():
                word = self.tokens[self.token_at(node.col_offset)][0]
                self.steps.append(("name", word) if word in self.names else _CONSTANTS[word])
            case ast.Call(func=ast.Name()):
                self.call(node, depth)
            case ast.UnaryOp(op=operator, operand=operand):
                self.visit(operand, depth + 1)
                if isinstance(operator, ast.USub) and isinstance(self.steps[-1], float):
                    self.steps[-1] = -self.steps[-1]
                elif not isinstance(operator, ast.UAdd):
                    self.steps.append(type(operator))
            case ast.BinOp():
                self.binary(node, depth)
            case ast.BoolOp(op=operator, values=[first, *others]):
                self.visit(first, depth + 1)
                for other in others:
                    self.visit(other, depth + 1)
                    self.steps.append(type(operator))
            case ast.Compare(left=first, ops=[operator], comparators=[second]):
                self.visit(first, depth + 1)
                self.visit(second, depth + 1)
                self.steps.append(type(operator))
            case ast.Compare(comparators=[second, *_]):
                raise self.error(self.token_after(second), "'and' between two comparisons")
            case ast.Tuple(elts=[first, *_]):
                raise self.error(self.token_after(first), "an operator or the end")
            case _:
                raise self.error(self.token_at(node.col_offset), _OPERAND)

    def binary(self, node: ast.BinOp, depth: int) -> None:
        """Append a sum, product or power. A loop follows the left operands, since sums may be long."""
        operations: list[ast.BinOp] = []
        first: ast.expr = node
        while isinstance(first, ast.BinOp):
            operations.append(first)
            first = first.left
        self.visit(first, depth + 1)
        for operation in reversed(operations):
            self.visit(operation.right, depth + 1)
            exponent = self.steps[-1] if isinstance(operation.op, ast.Pow) else None
            if isinstance(exponent, float) and abs(exponent) <= _LARGEST_POWER and exponent == int(exponent):
                self.steps[-1] = ("power", int(exponent))
            else:
                self.steps.append(type(operation.op))

    def call(self, node: Any, depth: int) -> None:
        """Append the arguments of a function and the function."""
        word = self.tokens[self.token_at(node.col_offset)][0]
        count, _ = _FUNCTIONS[word]
        for argument in node.args[:count]:
            self.visit(argument, depth + 1)
        taken = f"the {count} argument{'s' * (count > 1)} of {word}"
        if len(node.args) > count:
            raise self.error(self.token_after(node.args[count - 1]), f"')' after {taken}")
        if len(node.args) < count:
            raise self.error(self.token_at(node.end_col_offset - 1), f"',' between {taken}")
        self.steps.append(word)

    def token_at(self, column: int) -> int:
        """The index of the token at a column of the source that Python has read."""
        return sum(start <= column for start in self.columns) - 1

    def token_after(self, node: ast.expr) -> int:
        """The index of the first token after a node that is not a closing parenthesis."""
        index = self.token_at((node.end_col_offset or 1) - 1) + 1
        return next(place for place in range(index, len(self.tokens)) if self.tokens[place][0] != ")")

    def too_deep(self, index: int) -> FormulaError:
        """The mistake of a formula that nests too deeply."""
        return self.error(index, f"at most {_DEEPEST} levels of parentheses and signs")

    def error(self, index: int, expected: str) -> FormulaError:
        """The mistake at a token, or at the end of the text."""
        is_end = index >= len(self.tokens)
        column = len(self.text) if is_end else self.tokens[index].start()
        word = "the end" if is_end else repr(cut(self.tokens[index][0], 40))
        return FormulaError(f'"{cut(self.text, 80)}", column {column + 1}: expected {expected}, found {word}.')
