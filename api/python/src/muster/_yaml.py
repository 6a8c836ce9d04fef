"""The part of YAML that kubeconfigs are written in, by the controller and by kubectl; JSON is read as well.

Block mappings and sequences, plain and quoted scalars on one line, comments, ``{}`` and ``[]``. Whatever else YAML has
(anchors, tags, block scalars, flow collections with content) is refused by line: guessing at credentials helps nobody.
Scalars stay text.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import Any, Optional, Union

Node = Union[str, None, "list[Any]", "dict[str, Any]"]


class YamlError(ValueError):
    def __init__(self, line: int, what: str) -> None:
        super().__init__(f"line {line}: {what}")


@dataclass
class _Line:
    number: int
    indent: int
    text: str


#: A quoted or a plain key, and what follows on the line.
_KEY = re.compile(r"""("(?:[^"\\]|\\.)*"|'(?:[^']|'')*'|[A-Za-z0-9_./-][^#:"']*?)\s*:(?:\s+(.*))?$""")


def parse(text: str) -> Node:
    if text.lstrip().startswith("{"):
        try:
            value: Node = json.loads(text)
        except ValueError as error:
            raise YamlError(1, f"starts as JSON does, but is not: {error}") from None
        return value
    lines = _lines(text)
    if not lines:
        return None
    value, rest = _block(lines, lines[0].indent)
    if rest:
        raise YamlError(rest[0].number, "is indented less than what it belongs to")
    return value


def _lines(text: str) -> list[_Line]:
    found: list[_Line] = []
    for number, raw in enumerate(text.splitlines(), 1):
        bare = raw.strip()
        if not bare or bare.startswith("#") or (bare == "---" and not found):
            continue
        indent = len(raw) - len(raw.lstrip(" "))
        if raw[indent] == "\t":
            raise YamlError(number, "is indented with a tab")
        if bare in ("---", "..."):
            raise YamlError(number, "more than one document")
        found.append(_Line(number, indent, raw[indent:].rstrip()))
    return found


def _block(lines: list[_Line], indent: int) -> tuple[Node, list[_Line]]:
    if _is_item(lines[0].text):
        return _sequence(lines, indent)
    return _mapping(lines, indent)


def _is_item(text: str) -> bool:
    return text == "-" or text.startswith("- ")


def _sequence(lines: list[_Line], indent: int) -> tuple[Node, list[_Line]]:
    items: list[Any] = []
    while lines and lines[0].indent == indent and _is_item(lines[0].text):
        first, lines = lines[0], lines[1:]
        inner = first.text[1:].lstrip()
        if not inner or inner.startswith("#"):
            item, lines = _nested(first.number, lines, indent + 1)
        elif _KEY.match(inner):
            # "- name: x" opens a mapping whose other keys stand below "name".
            lines = [_Line(first.number, indent + len(first.text) - len(inner), inner), *lines]
            item, lines = _block(lines, lines[0].indent)
        else:
            item = _scalar(inner, first.number)
        items.append(item)
    return items, lines


def _mapping(lines: list[_Line], indent: int) -> tuple[Node, list[_Line]]:
    found: dict[str, Any] = {}
    while lines and lines[0].indent == indent and not _is_item(lines[0].text):
        line, lines = lines[0], lines[1:]
        match = _KEY.match(line.text)
        if match is None:
            raise YamlError(line.number, "is not `key: value`")
        key = _text(match.group(1), line.number)
        if key in found:
            raise YamlError(line.number, f"{key} is there twice")
        value = match.group(2) or ""
        if value and not value.startswith("#"):
            found[key] = _scalar(value, line.number)
        elif lines and lines[0].indent == indent and _is_item(lines[0].text):
            found[key], lines = _sequence(lines, indent)
        else:
            found[key], lines = _nested(line.number, lines, indent + 1)
    if lines and lines[0].indent > indent:
        raise YamlError(lines[0].number, "is indented more than its neighbours")
    return found, lines


def _nested(number: int, lines: list[_Line], least: int) -> tuple[Node, list[_Line]]:
    """What stands below line ``number``; nothing is null."""
    if lines and lines[0].indent >= least:
        return _block(lines, lines[0].indent)
    return None, lines


def _scalar(text: str, number: int) -> Node:
    bare = text if text[0] in "\"'" else re.split(r"\s#", text, maxsplit=1)[0].rstrip()
    if bare == "{}":
        return {}
    if bare == "[]":
        return []
    if bare in ("null", "~"):
        return None
    return _text(bare, number)


def _text(text: str, number: int) -> str:
    if text[0] == '"':
        end = re.match(r'("(?:[^"\\]|\\.)*")\s*(#.*)?$', text)
        try:
            value: Optional[str] = json.loads(end.group(1)) if end else None
        except ValueError:
            value = None
        if value is None:
            raise YamlError(number, "a quoted text that cannot be read")
        return value
    if text[0] == "'":
        end = re.match(r"'((?:[^']|'')*)'\s*(#.*)?$", text)
        if end is None:
            raise YamlError(number, "a quoted text that cannot be read")
        return end.group(1).replace("''", "'")
    if text[0] in "&*!|>%@`{[":
        raise YamlError(number, f"{text[0]!r} begins something that kubeconfigs do not need and this does not read")
    return text
