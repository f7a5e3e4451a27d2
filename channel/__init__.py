"""The simulated radio link: noise, fading, lost slots and frames, delay, traces.

Process
    emulator           passes symbols on as a radio link would
    emulator_settings  settings of the process
    delay              holds packets back for delay and jitter
    silence            says when no frame comes, and who is missing

Link
    link               what a frame's slots look like at the receiver
    settings           what can be set about a channel
    registry           channel models by name

Models
    awgn               additive white Gaussian noise
    fading             Rayleigh and Rician block fading
    erasure            lost slots and frames, in bursts
    trace              SNR over time
    slot_time          slots in time
    power              transmit power, the reference of every SNR
"""
