"""Types of command-line arguments, and options that several commands share."""

import argparse
from pathlib import Path
from typing import Any

OUT = Path("out")


def positive(text: str) -> float:
    """A positive, finite number."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a positive number, found {text!r}")
    return value


def count(text: str) -> int:
    """A whole number from 1 to 10,000."""
    if not text.isdecimal() or not 1 <= int(text) <= 10_000:
        raise argparse.ArgumentTypeError(f"expected a whole number from 1 to 10000, found {text!r}")
    return int(text)


def natural(text: str) -> int:
    """A whole number from 0, of at most 64 bits."""
    if not text.isdecimal() or int(text) >= 2**64:
        raise argparse.ArgumentTypeError(f"expected a whole number from 0, found {text!r}")
    return int(text)


def add_out(parser: Any, default: str) -> None:
    """Add the option ``--out``, whose default is described in words."""
    parser.add_argument("--out", type=Path, metavar="DIR", help=f"folder for the results (default: {default})")


def add_changes(parser: Any) -> None:
    """Add the option ``--set``."""
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="changes",
        help="change a value of the scenario, such as kinetics.feed=0.05; can be repeated",
    )  # fmt: skip


def add_repair(parser: Any) -> None:
    """Add the option ``--repair``."""
    parser.add_argument("--repair", action="store_true", help="repair the defects of a mesh file that can be repaired")


def add_restart(parser: Any, what: str) -> None:
    """Add the options ``--resume`` and ``--overwrite`` of a run or a fit."""
    parser.add_argument(
        "--resume", action="store_true", help=f"continue an interrupted {what}: the same command with the same --out"
    )
    parser.add_argument("--overwrite", action="store_true", help=f"start over and discard an interrupted {what}")
