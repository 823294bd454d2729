"""What the node knows of its own health: counters, times, and the verdict on them."""

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from line_feature_node.core import STEPS
from line_feature_node.options import Options

#: The percentiles are of the latest frames, at most so many, and at most so many seconds old.
WINDOW, AGE = 1000, 5.0
#: A jump of the sequence number by more is a publisher that began anew, not a loss.
LARGEST_JUMP = 10000
#: A publisher may be dead when so many frames came since its last one, and so many times as many as between that and
#: the one before; and another, whose latest number is at most so much lower, may have sent what seems to go on with it.
SILENT, TIMES, NEAR = 30, 3, 30


class Level(IntEnum):
    """Of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


class Throttle:
    """Keeps what may be said every so often from being said more often; each node has its own."""

    def __init__(self, period: float, clock: Callable[[], float] = time.monotonic) -> None:
        """Make it.

        Args:
            period: Seconds between two sayings of one kind.
            clock: Seconds.
        """
        self._period = period
        self._clock = clock
        self._said: dict[str, float] = {}

    def allows(self, kind: str) -> bool:
        """Whether something of a kind may be said now; then it counts as said."""
        now = self._clock()
        if now - self._said.get(kind, -np.inf) < self._period:
            return False
        self._said[kind] = now
        return True


@dataclass(frozen=True)
class Health:
    """The state of the node in a form for people and plots.

    Attributes:
        level: How it is.
        summary: One sentence.
        values: Figures by name, those that are numbers with point and without unit.
    """

    level: Level
    summary: str
    values: dict[str, str]


class Publishers(NamedTuple):
    """How many publishers the image topic has.

    Attributes:
        all: Those that are known of.
        fitting: Those of them whose quality of service fits.
        foreign: Message type of one that sends another than is subscribed to; '' where all send that.
    """

    all: int
    fitting: int
    foreign: str = ''


@dataclass
class Counts:
    """Frames since the start."""

    received: int = 0
    processed: int = 0
    dropped: int = 0
    failed: int = 0


class Latest(NamedTuple):
    """The latest frame of a publisher.

    Attributes:
        number: Its sequence number.
        place: How many frames had come by then, of all publishers.
        every: How many came between it and the one before.
        owed: How many more frames are missing if its publisher is gone.
    """

    number: int
    place: int
    every: float = math.inf
    owed: int = 0


class Gaps:
    """Tells by publication sequence numbers how many frames never came, of one publisher or of several.

    Who published a frame is not known. Its number goes on with the nearest lower one of the latest of each publisher;
    taking a publisher for another so makes no difference to the sum, if both go on. Where one of them was dead, what is
    missing then is counted when it is forgotten.
    """

    def __init__(self) -> None:
        self._latest: list[Latest] = []  # of each publisher, in the order in which they came
        self._count = 0

    def missed(self, number: int, publishers: int) -> int:
        """How many frames are missing before this one.

        Args:
            number: Its sequence number.
            publishers: How many there are. One that was killed is among them for 20 s, until its lease ends.
        """
        self._count += 1
        missed, latest = 0, Latest(number, self._count)
        before = max(self._lower(number, LARGEST_JUMP), default=None)
        # Beyond a gap it may be the first frame of a publisher of which none came yet.
        if before is not None and (number == before.number + 1 or len(self._latest) >= publishers):
            self._latest.remove(before)
            missed = number - before.number - 1
            latest = latest._replace(every=self._count - before.place)
            if self._is_silent(before):
                self._owe(number, before)
        self._latest.append(latest)
        gone = self._latest[:-max(publishers, 1)]
        del self._latest[:len(gone)]
        return missed + sum(other.owed for other in gone)

    def _lower(self, number: int, most: int) -> list[Latest]:
        """Those of which a number is no more than so much higher."""
        return [latest for latest in self._latest if 0 < number - latest.number <= most]

    def _is_silent(self, latest: Latest) -> bool:
        return self._count - latest.place > max(SILENT, TIMES * latest.every)

    def _owe(self, number: int, silent: Latest) -> None:
        """Note what is missing if another publisher sent this frame, and the silent one is dead."""
        other = max((latest for latest in self._lower(number, NEAR) if not self._is_silent(latest)), default=None)
        if other is not None:
            owed = silent.number - other.number + silent.owed
            self._latest[self._latest.index(other)] = other._replace(owed=owed)


@dataclass
class Monitor:
    """Counts frames and measures times; told of each frame by the node.

    Attributes:
        counts: Frames since the start.
        reasons: How often frames failed for a reason, without its figures.
        last_error: The latest reason, '' without.
    """

    counts: Counts = field(default_factory=Counts)
    reasons: Counter[str] = field(default_factory=Counter)
    last_error: str = ''
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        self._gaps = Gaps()
        self._recent: deque[tuple[float, float, tuple[float, ...]]] = deque(maxlen=WINDOW)  # when, latency, steps
        self._segments = 0
        self._reported = Counts()
        self._reported_at = self._last_image = self.clock()

    def restart(self) -> None:
        """Images are waited for from now on, by a new subscription: its sequence numbers begin anywhere."""
        self._gaps = Gaps()
        self._last_image = self.clock()

    def receive(self, sequence: int | None, publishers: int = 1) -> None:
        """Count a frame and, by its publisher's sequence number, those before it that never came.

        Args:
            sequence: Publication sequence number; None where the middleware does not tell.
            publishers: How many there are.
        """
        self.counts.received += 1
        self._last_image = self.clock()
        if sequence is not None:
            self.counts.dropped += self._gaps.missed(sequence, publishers)

    def process(self, latency: float, times: Mapping[str, float], segments: int) -> None:
        """Count a frame that gave segments.

        Args:
            latency: Seconds from the publication of the image to that of the segments.
            times: Seconds of each step.
            segments: How many there are.
        """
        self.counts.processed += 1
        self._recent.append((self.clock(), latency, tuple(times[step] for step in STEPS)))
        self._segments = segments

    def fail(self, reason: str) -> None:
        """Count a frame that gave none."""
        self.counts.failed += 1
        self.last_error = reason
        self.reasons[reason.split(':', 1)[0][:80]] += 1
        if len(self.reasons) > WINDOW:  # of figures in them, from bytes that are noise
            self.reasons = Counter(dict(self.reasons.most_common(WINDOW // 2)))

    def health(self, options: Options, *, publishers: Publishers | None, waiting: str) -> Health:
        """The verdict on the time since it was last asked for.

        Args:
            options: Its thresholds are used.
            publishers: Those of the image topic; None while it is not subscribed to.
            waiting: What the node waits for while it is not subscribed.
        """
        now, latest = self.clock(), self.counts
        while self._recent and now - self._recent[0][0] > AGE:
            self._recent.popleft()
        elapsed = max(now - self._reported_at, 1e-9)
        since = Counts(**{name: count - getattr(self._reported, name) for name, count in vars(latest).items()})
        self._reported, self._reported_at = Counts(**vars(latest)), now
        level, summary = self._verdict(since, options, publishers, waiting, now - self._last_image)
        return Health(level, summary, self._values(since.processed / elapsed))

    def _verdict(
        self, since: Counts, options: Options, publishers: Publishers | None, waiting: str, silence: float,
    ) -> tuple[Level, str]:
        if publishers is None:
            return Level.OK, waiting
        if silence > options.image_timeout:
            return Level.ERROR, f'no image for {silence:.0f} s: {_reason_of_silence(publishers)}'
        if since.failed and not since.processed:
            return Level.ERROR, f'no image can be processed: {self.last_error}'
        if since.failed:
            return Level.WARN, f'{since.failed} of {since.received} images failed: {self.last_error}'
        coming = since.received + since.dropped
        if coming and since.dropped / coming > options.max_dropped:
            return Level.WARN, f'{since.dropped} of {coming} images were dropped'
        late = self._percentile(95)
        if late > options.max_latency:
            return Level.WARN, f'5 % of the segments come {late * 1e3:.0f} ms or later after their images'
        return Level.OK, f'{self._segments} segments in the last image'

    def _percentile(self, percent: float) -> float:
        return float(np.percentile([latency for _, latency, _ in self._recent], percent)) if self._recent else 0.0

    def _values(self, rate: float) -> dict[str, str]:
        steps = [steps for _, _, steps in self._recent]
        times = np.median(steps, axis=0) * 1e3 if steps else np.zeros(len(STEPS))
        return {
            **{f'frames {name}': str(count) for name, count in vars(self.counts).items()},
            'rate (Hz)': f'{rate:.1f}',
            **{f'latency p{percent} (ms)': f'{self._percentile(percent) * 1e3:.2f}' for percent in (50, 95, 99)},
            **{f'{step} (ms)': f'{time:.3f}' for step, time in zip(STEPS, times.tolist(), strict=True)},
            'extraction (ms)': f'{times.sum():.3f}',
            'segments': str(self._segments),
            'last error': self.last_error,
            **{f'failed: {reason}': str(count) for reason, count in self.reasons.most_common(5)},
        }


def _reason_of_silence(publishers: Publishers) -> str:
    if not publishers.all:
        return 'the topic has no publisher'
    if not publishers.fitting and publishers.foreign:
        return f'a publisher sends {publishers.foreign}, see the parameter image_transport'
    if not publishers.fitting:
        return 'what its publishers offer does not fit, see the log for the quality of service'
    return 'a publisher is there that sends nothing, or its images are lost on the way (docs/transport.md)'
