"""Reduced models in real time: a socket for a device at a thousand frames a second, a page for the eye at sixty."""
