"""Specification texts guided by coverage: atheris edits texts that reach new code of the parser."""

from __future__ import annotations

import random
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

SEEDS = 500
LONGEST = 2_000


def fuzz(seconds: float, seed: str, findings: Path) -> int:
    """Run for some seconds, and write texts with problems to files. Ends the process."""
    try:
        import atheris
    except ImportError:
        print("campaign: --guided takes atheris: pip install --group campaign", file=sys.stderr)
        return 2
    with atheris.instrument_imports(include=["spatial_replay.spec"]):
        import spatial_replay.spec.load
    assert spatial_replay.spec.load
    from attacks.cases import keep, run_case
    from attacks.texts import Texts

    attack = Texts()

    def one(data: bytes) -> None:
        case = {"text": data.decode("utf-8", "surrogateescape"), "formatted": True}
        outcome = run_case(attack, case, is_timed=True)
        if outcome.problems:
            print(f"texts: {outcome.problems[0]}: {keep(attack, case, outcome.problems, findings)}")

    with TemporaryDirectory(prefix="campaign-") as corpus:
        for number in range(SEEDS):
            text = attack.draw(random.Random(f"guided {seed} {number}"))["text"]
            (Path(corpus) / str(number)).write_bytes(text.encode("utf-8", "replace"))
        limits = [f"-max_total_time={seconds:.0f}", f"-max_len={LONGEST}", "-rss_limit_mb=500", "-timeout=10"]
        number = random.Random(seed).randrange(1, 2**31)
        atheris.Setup([sys.argv[0], *limits, f"-seed={number}", "-print_final_stats=1", corpus], one)
        # it prints its figures, and ends the process
        atheris.Fuzz()
    return 0
