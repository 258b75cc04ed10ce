"""Formulas have the value of the same arithmetic, are differentiable, and execute no code."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from ltljax.app.scenario.formulas import Formula, FormulaError, functions, parse

NAMES = ("a", "u", "v", "x", "y", "z")

# The text of a formula, and a Python function with the same value. Powers have integer exponents only.
leaves = st.one_of(
    st.floats(0.1, 3).map(lambda value: (repr(value), lambda u, v, value=value: value)),
    st.sampled_from([("u", lambda u, v: u), ("v", lambda u, v: v), ("pi", lambda u, v: math.pi)]),
)


def limited(value):
    """The value, if it is small: the sine of a large number, or a difference of two, consists of rounding errors."""
    if abs(value) > 1e4:
        raise OverflowError
    return value


def joined(children):
    def binary(sign, function):
        def join(pair):
            (first, f), (second, g) = pair
            return f"({first}) {sign} ({second})", lambda u, v: limited(function(f(u, v), g(u, v)))

        return st.tuples(children, children).map(join)

    def unary(text, function):
        return children.map(lambda child: (text.format(child[0]), lambda u, v: limited(function(child[1](u, v)))))

    return st.one_of(
        binary("+", lambda a, b: a + b),
        binary("-", lambda a, b: a - b),
        binary("*", lambda a, b: a * b),
        unary("sin({})", math.sin),
        unary("tanh({})", math.tanh),
        unary("-({})", lambda a: -a),
        unary("({})^2", lambda a: a**2),
        unary("({})**3", lambda a: a**3),
        unary("abs({})", abs),
    )


@settings(max_examples=100, deadline=None)
@given(st.recursive(leaves, joined, max_leaves=8), st.floats(-2, 2), st.floats(-2, 2))
def test_a_formula_has_the_value_of_the_same_arithmetic(formula, u, v):
    text, function = formula
    try:
        expected = function(u, v)
    except OverflowError:
        return
    np.testing.assert_allclose(parse(text, ("u", "v"))(u=u, v=v), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("2 + 3*4", 14), ("2*3 + 4", 10), ("2 - 3 - 4", -5), ("24/4/2", 3), ("2^3^2", 512), ("-2^2", -4),
        ("(-2)^2", 4), ("4^0.5", 2), ("2**-1", 0.5), ("2*-3", -6), ("+3", 3), (".5 + 1. + 1e-1", 1.6),
        ("9^9^9^9", math.inf), ("1/0", math.inf),
        ("1 < 2 and 3 < 2 or 1 == 1", 1), ("not 1 > 2", 1), ("1 + (2 > 1)", 2), ("2 != 2", 0), ("2 <= 2", 1),
        ("min(1, 2) + max(1, 2)", 3), ("where(2 > 1, 5, 6)", 5), ("step(-1) + step(1)", 1), ("clip(5, 0, 2)", 2),
        ("mod(7, 4)", 3), ("hypot(3, 4)", 5), ("atan2(1, 1)", math.pi / 4), ("smoothstep(0, 2, 1)", 0.5),
        ("log(e)", 1), ("floor(1.7) + sign(-3)", 0), ("exp(0)*cosh(0)", 1),
    ],
)  # fmt: skip
def test_operators_bind_as_in_mathematics(text, value):
    np.testing.assert_allclose(parse(text)(), value)


def test_powers_are_differentiated_at_zero_and_for_negative_bases():
    square, cube, root = (parse(text, ("u",)) for text in ("u^2", "u^3", "u^0.5"))
    assert jax.grad(lambda u: square(u=u))(0.0) == 0
    assert jax.grad(lambda u: cube(u=u))(-2.0) == 12
    assert jax.grad(lambda u: root(u=u))(4.0) == 0.25


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_formula_works_on_fields_in_their_float_type(dtype):
    formula = parse("where(z > 0, a*u^2, 0.1) + sin(pi*u)/2", NAMES)
    u, z = jnp.linspace(-1, 1, 5, dtype=dtype), jnp.array([1, -1, 1, -1, 1], dtype)
    values = jax.jit(lambda u: formula(u=u, z=z, a=jnp.asarray(2.0, dtype)))(u)
    assert values.dtype == dtype
    np.testing.assert_allclose(values, np.where(z > 0, 2 * u**2, 0.1) + np.sin(np.pi * u) / 2, rtol=1e-5)
    assert formula.names == ("a", "u", "z")


def test_equal_formulas_are_equal():
    assert parse("u + 1", NAMES) == parse("  u +1", NAMES)
    assert hash(parse("u + 1", NAMES)) == hash(parse("u+1.0", NAMES))
    assert parse("u + 1", NAMES) != parse("u + 2", NAMES)
    assert isinstance(parse("u", NAMES), Formula)
    assert str(parse("u^2", NAMES)) == "u^2"


def test_long_sums_are_evaluated():
    assert parse("+".join(["1"] * 900))() == 900


BROKEN = [
    "", " ", "a +", "* a", "a b", "a..b", "a, b", "(a", "a)", "()", "sin", "sin()", "sin(a, a)", "where(a, a)",
    "min(a)", "__import__('os').system('true')", "a.__class__", "().__class__.__bases__", "a[0]", "{a}", "lambda: a",
    "lambda x: x", "eval(a)", "exec(a)", "open(a)", "print(a)", "getattr(a, a)", "sin(a)(a)", "(sin)(a)", "'text'",
    '"text"', "a if u else v", "[a for a in u]", "a := 1", "a = 1", "a; u", "a\nu", "a\0", "\u0430 + 1", "a \uff0b 1",
    "1_000", "0x10", "1e", "1e999", "nan", "inf", "a < u < v", "a @ u", "a // u", "a % u", "a ! u", "a && u", "~a",
    "a?", "#a", "$a", "\\a", "`a`", "w + 1", "sine(a)", "os", "self", "True", "None", "(" * 500 + "a" + ")" * 500,
    "-" * 500 + "a", "sin(" * 300 + "a" + ")" * 300, "2^" * 400 + "2", "1+" * 2000 + "1", "not " * 400 + "a",
]  # fmt: skip


@pytest.mark.parametrize("text", BROKEN)
def test_a_text_that_is_not_a_formula_is_one_clear_error(text):
    with pytest.raises(FormulaError, match=r"(?s)[Ee]xpected .*found"):
        parse(text, NAMES)


def test_errors_name_the_column_and_the_near_miss():
    with pytest.raises(FormulaError, match=r'"a - u \+ w\*v", column 9: expected one of a, u, v.*found \'w\''):
        parse("a - u + w*v", ("a", "u", "v"))
    with pytest.raises(FormulaError, match="did you mean sin"):
        parse("sine(u)", ("u",))
    with pytest.raises(FormulaError, match="did you mean feed"):
        parse("fed*u", ("u", "feed"))
    assert "sin" in functions()


@settings(max_examples=300, deadline=None)
@given(st.text(alphabet="auv0123456789.()+-*/^<>=!, sincowhreanot_e\"'[]{}", max_size=60))
def test_any_text_is_parsed_or_refused(text):
    try:
        formula = parse(text, NAMES)
    except FormulaError:
        return
    jnp.asarray(formula(**dict.fromkeys(formula.names, 1.0)))


def test_a_name_may_be_a_word_of_python():
    formula = parse("self + values*lambda", ("self", "values", "lambda"))
    assert float(formula(**{"self": 1.0, "values": 2.0, "lambda": 3.0})) == 7


@pytest.mark.parametrize(
    ("text", "column", "expected"),
    [
        ("a + 1 )", 7, "an operator or the end, found ')'"),
        ("2*(a + ", 8, "a number, a name or '(', found the end"),
        ("2*(a + u", 9, "an operator or ')', found the end"),
        ("a < u < v", 7, "'and' between two comparisons, found '<'"),
        ("a < (u) < v", 9, "'and' between two comparisons, found '<'"),
        ("min(a, (u))) + 1", 12, "an operator or the end, found ')'"),
        ("min(a, u, v)", 9, "')' after the 2 arguments of min, found ','"),
        ("min((a))", 8, "',' between the 2 arguments of min, found ')'"),
        ("a + , u", 5, "a number, a name or '(', found ','"),
        ("(a + u, v)", 7, "an operator or the end, found ','"),
        ("a * not u", 5, "'(' before 'not', found 'not'"),
        ("1e999 + a", 1, "a number of at most 1e308, found '1e999'"),
        ("a^2 + u ? v", 9, "a number, a name, an operator or a parenthesis, found '?'"),
    ],
)
def test_errors_point_at_the_first_mistake(text, column, expected):
    with pytest.raises(FormulaError) as error:
        parse(text, NAMES)
    assert str(error.value) == f'"{text}", column {column}: expected {expected}.'
