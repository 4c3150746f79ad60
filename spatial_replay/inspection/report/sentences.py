"""Sentences with formulas in them → what of them is text, and what is code."""

from __future__ import annotations

import re
from typing import Final

_CODE: Final = re.compile(
    r"""
    (?<![^\s(]) `                           # what quotes a formula follows a space or a parenthesis
    ( (?: "(?:[^"\\]|\\.)*" | [^`"] )*    # a name in its own quotes may have such signs in it
      (?: "[^"]*… )? )                       # and may be cut short
    ` (?= [\s,.:;)] | $ )
    """,
    re.VERBOSE,
)


def sentence_parts(sentence: str) -> list[str]:
    """The parts of a sentence: text and code, in turn, beginning with text.

    Code stands between backquotes, which names of objects may have in them, too.
    """
    return _CODE.split(sentence)
