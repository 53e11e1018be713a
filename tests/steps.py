"""Steps for checks of derivatives of bodies."""

STEPS = (1 / 32, 1 / 64, 1 / 128)  # an error is extrapolated from three of them; each is a solve along each direction
