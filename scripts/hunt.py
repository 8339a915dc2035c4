"""Hunt for faults: random legal plants over all that is accepted, held against independent answers.

    python scripts/hunt.py                               every check, about five minutes in all
    python scripts/hunt.py --minutes 60 --seed 7         longer, other plants
    python scripts/hunt.py --only steps --plants 2000000
    python scripts/hunt.py --replay steps-0-1234         one trial again, as a failure names it

Prints for each check how many trials were tried, held, set aside (and why) and failed; exit status 1 if any failed.
Ctrl-C ends the check that runs, prints what was found until then, and stops.
"""

import argparse
import contextlib
import math
import sys
import time
from collections import Counter
from dataclasses import dataclass, field

from scripts.hunting import against_scipy, environments, events, files, fuzz, labels, motions, steps
from scripts.hunting.trials import Check, Failure, Outcome, SetAside, outcomes

CHECKS = {
    check.name: check
    for check in (
        steps.CHECK,
        steps.SLOW,
        against_scipy.CHECK,
        events.CHECK,
        environments.BATCHES,
        environments.INTERPRETED,
        environments.INFOS,
        motions.ATTRACTORS,
        motions.MULTIPLIERS,
        labels.CHECK,
        files.CHECK,
        fuzz.LEGAL,
        fuzz.ARGUMENTS,
        fuzz.COMMANDS,
    )
}
_SHOWN = 5  # failures of each kind
_MOST_ENDED = 20  # trials that had to be ended, before a check is left


@dataclass
class Findings:
    """What became of a check's trials: ``failures`` and ``greatest`` numbers with their index."""

    tried: int = 0
    held: int = 0
    ended: int = 0
    aside: Counter[str] = field(default_factory=Counter)
    failures: dict[int, str] = field(default_factory=dict)
    greatest: dict[str, tuple[float, int]] = field(default_factory=dict)

    def add(self, found: Outcome) -> None:
        """Count one trial."""
        self.tried += 1
        self.held += found.kind == "held"
        self.ended += found.ended
        if found.kind == "aside":
            self.aside[found.words] += 1
        elif found.kind == "failed":
            self.failures[found.number] = found.words
        for name, value in found.numbers.items():
            if not value <= self.greatest.get(name, (-1.0, 0))[0]:
                self.greatest[name] = value, found.number

    def show(self, check: Check, seed: int) -> None:
        """Print what became of a check."""
        print(f"\n{check.name}: {check.title}")
        print(f"  tried {self.tried}, held {self.held}, failed {len(self.failures)}")
        for reason, count in self.aside.most_common():
            print(f"  set aside: {count} ({reason})")
        for name, (value, index) in self.greatest.items():
            print(f"  {name}: {value:.3g} ({check.name}-{seed}-{index})")
        for kind, count in Counter(map(kind_of, self.failures.values())).most_common():
            print(f"  failed: {count} ({kind})")
            for index, words in [each for each in sorted(self.failures.items()) if kind_of(each[1]) == kind][:_SHOWN]:
                print(f"    FAILED {check.name}-{seed}-{index}: {words}")
        sys.stdout.flush()


def kind_of(words: str) -> str:
    """Return the kind of a failure, the part of its words in brackets."""
    return words[1 : words.index("]")]


def hunt(check: Check, seed: int, first: int, count: float, seconds: float) -> tuple[Findings, bool]:
    """Run trials of a check from index ``first`` on, until ``count`` are done, ``seconds`` are over or too many had to
    be ended; return the findings, and whether the user stopped it."""
    findings, begun = Findings(), math.inf
    with contextlib.closing(outcomes(check, seed, first)) as found:
        try:
            while findings.tried < count and time.monotonic() - begun < seconds and findings.ended < _MOST_ENDED:
                each = next(found)
                begun = min(begun, time.monotonic())  # the time to compile does not count
                if each is not None:
                    findings.add(each)
                if sys.stderr.isatty():
                    print(
                        f"\r{check.name}: {findings.tried} tried, {len(findings.failures)} failed",
                        end="\r",
                        file=sys.stderr,
                    )
        except KeyboardInterrupt:
            print("\ninterrupted", file=sys.stderr)
            return findings, True
    return findings, False


def replay(name: str) -> int:
    """Run one trial in this process; return the exit status."""
    check, seed, index = ["", "", "", *name.rsplit("-", 2)][-3:]
    if check not in CHECKS or not (seed.isdigit() and index.isdigit()):
        print(f"--replay must be CHECK-SEED-INDEX with a check of {', '.join(CHECKS)}, got {name!r}", file=sys.stderr)
        return 2
    chosen = CHECKS[check]
    print(chosen.drawn(int(seed), int(index)), flush=True)
    chosen.prepare()
    try:
        print(f"held {dict(chosen.trial(int(seed), int(index)) or {})}")
    except SetAside as reason:
        print(f"set aside: {reason}")
    except Failure as found:
        print(f"FAILED: {found}")
        return 1
    return 0


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0, help="of all that is drawn (default: 0)")
    parser.add_argument("--minutes", type=float, default=5.0, help="for all checks together (default: 5)")
    parser.add_argument("--plants", type=int, metavar="N", help="so many trials of each check, however long they take")
    parser.add_argument("--first", type=int, default=0, metavar="INDEX", help="of the trials (default: 0)")
    parser.add_argument("--only", nargs="+", choices=CHECKS, metavar="CHECK", help=f"of {', '.join(CHECKS)}")
    parser.add_argument("--replay", metavar="CHECK-SEED-INDEX", help="run one trial here, and let its error through")
    chosen = parser.parse_args(arguments)
    if chosen.replay:
        return replay(chosen.replay)
    checks = [CHECKS[name] for name in chosen.only or CHECKS]
    shares = sum(check.share for check in checks)
    failed = 0
    for check in checks:
        seconds = math.inf if chosen.plants else 60.0 * chosen.minutes * check.share / shares
        findings, interrupted = hunt(check, chosen.seed, chosen.first, chosen.plants or math.inf, seconds)
        findings.show(check, chosen.seed)
        if interrupted:
            return 1
        failed += len(findings.failures)
    print(f"\n{failed} failed" if failed else "\nall held")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
