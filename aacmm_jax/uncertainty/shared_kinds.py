"""Names of the shared errors; imports nothing, for commands that only show results."""

PLACES, VISITS, SUCCESSIVE = "places", "visits", "successive poses"  # kinds that move the tips of poses alike
