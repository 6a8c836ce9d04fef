"""Amounts as manifests write them: cpu ``"500m"`` or ``2``, memory ``"64Mi"`` or a number of bytes."""

from __future__ import annotations

import re
from decimal import ROUND_CEILING, Decimal
from typing import Union

#: ``"500m"`` (thousandths of a core), ``"2"``, ``0.5`` (cores).
Cpu = Union[str, int, float]
#: ``"64Mi"``, ``"2G"``, or bytes.
Memory = Union[str, int]

_NUMBER = re.compile(r"(\d+\.?\d*|\.\d+)(e[+-]?\d+)?")
_BYTES = {"": 1, "k": 10**3, "M": 10**6, "G": 10**9, "T": 10**12, "P": 10**15}
_BYTES.update({"Ki": 2**10, "Mi": 2**20, "Gi": 2**30, "Ti": 2**40, "Pi": 2**50})


def cpu_millis(amount: Cpu) -> int:
    """Thousandths of a core, rounded up as the controller does: nothing gets less than it asked for."""
    text = str(amount).strip()
    digits, factor = (text[:-1], 1) if text.endswith("m") else (text, 1000)
    return _whole(digits, factor, f"{amount!r} is not a quantity of cpu; try \"2\" or \"500m\"")


def memory_bytes(amount: Memory) -> int:
    """Bytes, rounded up."""
    text = str(amount).strip()
    digits = text.rstrip("kKMGTPi")
    wrong = f"{amount!r} is not a quantity of bytes; try \"64Mi\""
    if text[len(digits) :] not in _BYTES:
        raise ValueError(wrong)
    return _whole(digits, _BYTES[text[len(digits) :]], wrong)


def _whole(digits: str, factor: int, wrong: str) -> int:
    if _NUMBER.fullmatch(digits) is None:
        raise ValueError(wrong)
    amount = Decimal(digits) * factor
    if amount >= 2**63:
        raise ValueError(wrong)
    return int(amount.to_integral_value(ROUND_CEILING))
