"""The shadow: another model on the same live samples, published to nobody.

It passes the same pauses, zeros and probes as the present compensation. Its own limits, holds and offsets do not count.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec

from compensator.codes import ProbeCode
from compensator.config import Config
from compensator.events import EventKind
from compensator.messages import Probe
from compensator.service.compensation import Compensation, Outcome, model_of
from compensator.service.probing import ReceivedProbe


@dataclass(slots=True)
class Shadow:
    """Another model, with its compensation after the last sample.

    Parameters
    ----------
    compensation : Compensation
        Its compensation.
    data : bytes
        Its model file.
    """

    compensation: Compensation
    data: bytes

    @classmethod
    def of(cls, config: Config, data: bytes, state: bytes, *, source: str) -> Shadow:
        """Return the shadow of a recording, from its model file, whose name is `source`, and state.

        Raises
        ------
        CompensatorError
            If they cannot be used with the configuration.
        """
        compensation = Compensation(config, model_of(config, data, source=source))
        compensation.restore(state)
        return cls(compensation, data)

    def follow(self, outcome: Outcome, *, probes: bool = True) -> Outcome | None:
        """Process a live sample after a warm-up on the recordings; None if they had it.

        What lies between the two was not on disk in time for the warm-up: it is a pause. With `probes` probes correct
        the prediction.
        """
        last = self.compensation.status.seq
        missing = outcome.sample.seq - last - 1
        if missing < 0:
            return None
        if last >= 0:
            self.compensation.pause(missing)
        return self.process(outcome if probes else msgspec.structs.replace(outcome, probes=()))[1]

    def process(self, outcome: Outcome) -> tuple[Outcome, Outcome]:
        """Process the next sample of the present compensation.

        Returns
        -------
        Outcome, Outcome
            The present one's with the compared probes alone, and the shadow's.
        """
        for note in outcome.notes:
            if note.kind == EventKind.ZERO:
                self.compensation.zero(note.data["mode"])
        probes = tuple(probe for probe in outcome.probes if _is_compared(probe))
        received = [ReceivedProbe.of(probe, is_checked=True) for probe in probes]
        self.compensation.receive_probes([probe for probe in received if probe is not None])
        other = self.compensation.process(outcome.sample)
        self.compensation.believe_as_in_force(outcome.offset.reasons)
        return msgspec.structs.replace(outcome, probes=probes), other


def _is_compared(probe: Probe) -> bool:
    """Return whether a probe passed the checks against what was published, which only the present model can make."""
    return probe.is_read and (probe.taken or probe.code == ProbeCode.OUTLIER)
