"""What each command refuses before it starts anything, as it is typed. The golden pages have what it says."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from tests.conftest import Evedrop
from tests.golden.pages import Golden

REFUSED = {
    "montecarlo": """
        montecarlo
        montecarlo nothing
        montecarlo eavesdroppr
        montecarlo eavesdroppers --sluts 3
        montecarlo eavesdroppers --slots 0
        montecarlo eavesdroppers --trials 0
        montecarlo eavesdroppers --trials many
        montecarlo eavesdroppers --set seed
        montecarlo eavesdroppers --set sluts=3 --set legitimate.link.quality=7
        montecarlo eavesdroppers --workers 0
        montecarlo eavesdroppers --out full
        montecarlo eavesdroppers --out full/file
        montecarlo eavesdroppers --out full/file/x
        montecarlo eavesdroppers --secret short
        montecarlo eavesdroppers --secret nowhere
        montecarlo eavesdroppers --resume
        montecarlo eavesdroppers --wire-key robot/pose
        montecarlo eavesdroppers --json --csv table.csv
        montecarlo microgrid --covariance-only
        """,
    "run": """
        run
        run nothing
        run eavesdroppers --view blue
        run eavesdroppers --serve nowhere
        run eavesdroppers --view off --listen 17447
        run eavesdroppers --view off --listen tcp/127.0.0.1:0
        run eavesdroppers --view off --listen tcp/127.0.0.1:65536
        run eavesdroppers --view off --listen udp/127.0.0.1:17447
        run eavesdroppers --view off --listen tcp/0.0.0.0:17447
        run eavesdroppers --view off --hosts nowhere.toml
        run eavesdroppers --view off --wire-side sensor
        run eavesdroppers --view off --set sluts=3 --set legitimate.link.quality=7
        run eavesdroppers --view off --set network.shards=0
        run eavesdroppers --view off --out full
        """,
    "sweep": """
        sweep eavesdroppers --trials 5
        sweep eavesdroppers --trials 5 --over slots
        sweep eavesdroppers --trials 5 --over =1,2
        sweep eavesdroppers --trials 5 --over slots=
        sweep eavesdroppers --trials 5 --over seed=1 --over seed=2
        sweep eavesdroppers --trials 5 --over seed=5:1:1
        sweep eavesdroppers --trials 5 --over seed=1:2
        sweep eavesdroppers --trials 5 --over slots=1:nan:1
        sweep eavesdroppers --trials 5 --over slots=0:1:1e-9
        sweep eavesdroppers --trials 5 --over slots=0:1:0.001 --over seed=0:1:0.01
        sweep eavesdroppers --trials 5 --over sluts=1,2
        sweep eavesdroppers --trials 5 --over encoding.foo=1,2
        sweep eavesdroppers --trials 0 --over seed=1,2
        sweep eavesdroppers --trials 5 --over seed=1,2 --workers 0
        sweep eavesdroppers --trials 5 --over seed=1,2 --out full
        """,
    "compare": """
        compare nothing
        compare numerical --schemes cypher,plain --adversaries smrt --with innovation.mu_d=0.7
        compare numerical --schemes plain --with plain.depth=3
        compare numerical --trials 0
        compare measured --schemes twin-track --adversaries naive
        compare numerical --schemes plain --adversaries naive --out full
        """,
    "report": """
        report nowhere
        report full
        report full/file
        """,
    "view": """
        view nowhere
        view full
        view done --slot 3 --slots 1:2
        view done --time 3
        view done --picture done.jpg
        view done --video done.mp3
        view done --slots 1:2
        view done --picture a.png --times 1:2
        view done --panel scene
        view done --slot 3
        view done --slot 0
        view done --table --size 300x300
        view done --picture done.png --fps 5
        view done --picture done.png --csv done.csv
        view done --verbose
        view done --table --serve nonsense
        """,
    "diff": """
        diff done
        diff done nowhere
        diff full done
        """,
    "export": """
        export done
        export nowhere run.mcap
        export done run.bag
        export done run.csv --period 2
        export done --mcap
        """,
    "test": """
        test full
        test full bare
        test vehicle --jobs 0
        test vehicle --scheduler tcp://127.0.0.1:8786
        test vehicle --resume
        """,
    "cost": """
        cost microgrid --workers 0
        """,
    "status": """
        status
        status nowhere
        status done
        """,
    "step": """
        step done 0
        step done 3
        """,
    "link": """
        link done smart
        link done smart quality
        link done smart cut heal
        link done smart quality=0.2
        """,
    "brief": """
        brief eavesdroppers
        brief nothing --out briefs
        brief eavesdroppers --out briefs --wait 0
        brief eavesdroppers --out briefs --overwrite
        brief eavesdroppers --out full
        """,
}
"""Command → lines, typed in a folder that has `full`, a folder with a file; `done`, a study; and `short`, too short a secret."""


def everything(folder: Path) -> set[str]:
    """What is in a folder."""
    return {str(path) for path in folder.rglob("*")}


@pytest.mark.parametrize("command", REFUSED)
def test_what_a_command_refuses(command: str, evedrop: Evedrop, golden: Golden) -> None:
    """Status 2, a sentence on standard error, nothing on standard output and nothing in the folder."""
    (evedrop.folder / "full").mkdir()
    (evedrop.folder / "full" / "file").touch()
    (evedrop.folder / "bare").mkdir()
    (evedrop.folder / "short").write_bytes(b"3" * 31)
    if " done" in REFUSED[command]:
        study = ("montecarlo", "eavesdroppers", "--slots", "9", "--trials", "1", "--workers", "1", "--out", "done")
        assert evedrop(*study).status in {0, 1}
    assert evedrop.temporary.is_dir()
    before = everything(evedrop.folder)
    for line in REFUSED[command].strip().splitlines():
        done = evedrop(*shlex.split(line))
        assert (done.status, done.out) == (2, ""), (line, done.status, done.out)
        assert "Traceback" not in done.err
        golden(command, f"$ evedrop {line.strip()}", done.err)
    assert everything(evedrop.folder) == before


def test_a_sweep_and_a_comparison_are_named(evedrop: Evedrop) -> None:
    """Where the results folder of a run is expected."""
    small = ("--trials", "2", "--slots", "5", "--set", "expect=[]")
    assert evedrop("sweep", "eavesdroppers", "--over", "seed=1,2", *small, "--out", "swept").status == 0
    schemes = ("--schemes", "plain", "--adversaries", "naive")
    assert evedrop("compare", "eavesdroppers", *schemes, *small, "--out", "compared").status == 0
    for folder, study in (("swept", "sweep"), ("compared", "comparison")):
        for words in (("view", folder), ("diff", folder, folder), ("export", folder, "run.mcap")):
            done = evedrop(*words)
            assert (done.status, done.out) == (2, "")
            assert f"{folder} is the folder of a {study}; give the results folder of a run" in done.err
