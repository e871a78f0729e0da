"""Names of the processes of a run."""

from __future__ import annotations

SENSOR = "sensor"
LEGITIMATE = "legitimate"
ROUTER = "router"
OBSERVER = "observer"
OPERATOR = "operator"
CONTROLLER = "controller"
ACKNOWLEDGEMENTS = "acknowledgements"
"""No process: the name of their way back, whose random stream is `link/acknowledgements`."""
RELAY = "relay"
RESERVED = (SENSOR, LEGITIMATE, ROUTER, RELAY, OBSERVER, OPERATOR, CONTROLLER, ACKNOWLEDGEMENTS)
