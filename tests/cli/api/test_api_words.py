"""Advice in the words of Python."""

from __future__ import annotations

import pytest

from evedrop import Scenario, cost, design, montecarlo, run
from evedrop.cli.main import main
from evedrop.cli.words import in_python
from evedrop.errors import UsageError
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.simulation import Mode
from tests.builders import GOOD

SMALL = Scenario(GOOD).replace(slots=12)


def test_results_of_python_advise_arguments() -> None:
    """The file keeps the words of the command."""
    lost = SMALL.replace(legitimate__link={"quality": 0.999}, eavesdroppers__smart__link={"quality": 1.0})
    rare = lost.replace(process={"A": [[1.0]], "Q": [[1.0]], "initial_covariance": [[1e6]]})
    results = montecarlo(rare.replace(encoding__state_probability=0.02), trials=100)
    sentence = results.secrecy["smart"].sentence
    assert " montecarlo(…, plan=Plan(rare=True)) estimates its mean;" in sentence
    assert sentence in results._repr_html_().replace("&#34;", '"')
    assert " montecarlo --rare estimates its mean;" in results.summary["secrecy"]["smart"]["sentence"]
    assert Plan(rare=True).rare
    assert in_python("2 trials would do; montecarlo --rare estimates it") == (
        "2 trials would do; montecarlo(…, plan=Plan(rare=True)) estimates it"
    )


def test_errors_of_python_name_arguments(capsys: pytest.CaptureFixture[str]) -> None:
    """And calls, which can be made; a command, which uses the same functions, names options and commands."""
    with pytest.raises(UsageError, match=r"^trials=1: expected 2 or more"):
        cost("microgrid", trials=1, slots=10)
    with pytest.raises(UsageError, match=r"^listen=tls/10\.0\.0\.1:1 is not a loopback endpoint"):
        run(SMALL, listen="tls/10.0.0.1:1")
    with pytest.raises(UsageError, match='leave mode="covariance-only" out'):
        montecarlo("late", trials=2, plan=Plan(Mode.COVARIANCE_ONLY))
    changes = {"eavesdroppers.jammer.link.quality": 0.5}
    with pytest.raises(UsageError) as caught:
        design("acknowledged", changes=changes)
    message = str(caught.value)
    assert "; compare(SCENARIO, schemes=['acknowledged', 'innovation'], out=DIR) measures both" in message
    assert message.endswith(
        "measure acknowledged: montecarlo('acknowledged', eavesdroppers__jammer__link__quality=0.5)"
    )
    assert design("bayesian").measuring.startswith("sweep('bayesian', {'encoding.state_probability': [0.1, 0.2,")
    assert main(["design", "acknowledged"]) == 2
    line = " ".join(capsys.readouterr().err.split())
    assert "evedrop compare SCENARIO --schemes acknowledged,innovation --out DIR measures both" in line
    assert line.endswith("evedrop montecarlo acknowledged")
