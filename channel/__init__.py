"""The simulated radio link: noise, fading, lost slots and frames, delay, traces."""
