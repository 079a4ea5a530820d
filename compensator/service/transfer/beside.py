"""Two models that were compared with the present one, compared with each other on the hours of both."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from operator import attrgetter

from compensator.service.transfer.two_models import BLOCK_NS, Block, ComparedProbe, ComparisonState


def beside(rival: ComparisonState, other: ComparisonState, *, level_um: float = 0.0) -> ComparisonState:
    """Return the comparison of one model with another one, as if that were the present one, on the hours of both.

    Parameters
    ----------
    rival, other : ComparisonState
        Of the present model with the one that stands for it, and with the other one; of the first since it has been
        compared itself.
    level_um : float
        By how much the level of the first one is raised, µm.
    """
    zeros: dict[tuple[int, int], int] = {}
    blocks = []
    for own, block in _paired(rival, other):
        if own.means is None or block.means is None:
            continue
        # Changes count about one zero of both.
        zero = zeros.setdefault((own.zeros, block.zeros), len(zeros))
        square = own.squares[1] + own.samples * level_um * (level_um - 2.0 * own.means[1])
        means = (own.means[1] - level_um, block.means[1], block.means[2])
        blocks.append(Block(zero, block.number, min(own.samples, block.samples), (square, block.squares[1]), means))
    shown = {probe.time_utc_ns: probe.other_um for probe in rival.own_probes}
    probes = [
        ComparedProbe(probe.time_utc_ns, shown[probe.time_utc_ns], probe.other_um)
        for probe in other.probes
        if probe.time_utc_ns in shown
    ]
    begins_ns = [block.number * BLOCK_NS for block in blocks[:1]] + [probe.time_utc_ns for probe in probes[:1]]
    return ComparisonState(
        zeros=len(zeros),
        blocks=blocks,
        probes=probes,
        first_ns=min(begins_ns, default=0),
        last_ns=other.last_ns if begins_ns else 0,
        model_ns=other.model_ns,
    )


def _paired(rival: ComparisonState, other: ComparisonState) -> Iterator[tuple[Block, Block]]:
    """Yield the blocks of the same samples: a half hour in which a zero was set is two blocks of both.

    One that is divided in one comparison alone, where a model has taken over, has no counterpart.
    """
    theirs, its = ({n: list(found) for n, found in groupby(one.blocks, attrgetter("number"))} for one in (rival, other))
    for number, blocks in its.items():
        if number * BLOCK_NS >= rival.model_ns and len(theirs.get(number, ())) == len(blocks):
            yield from zip(theirs[number], blocks, strict=True)
