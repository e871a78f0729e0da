"""Names of the processes of a run."""

from __future__ import annotations

SENSOR = "sensor"
LEGITIMATE = "legitimate"
ROUTER = "router"
OBSERVER = "observer"
OPERATOR = "operator"
CONTROLLER = "controller"
ACKNOWLEDGEMENTS = "acknowledgements"
"""Not a process: the name of the link of acknowledgements, whose random stream is `link/acknowledgements`."""
RELAY = "relay"
RESERVED = (SENSOR, LEGITIMATE, ROUTER, RELAY, OBSERVER, OPERATOR, CONTROLLER, ACKNOWLEDGEMENTS)
