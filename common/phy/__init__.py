"""Physical layer shared by both radio ends: slots, pilots, 16-QAM, equaliser, LDPC.

Frame
    slots               the grid of channel uses
    pilots              known symbols at the head of a slot
    allocation          how many values each block sends
    hashing             pseudo-random words that both ends compute alike

Receiver
    equaliser           channel and noise estimation, MMSE equalisation

Coded modulation
    qam                 Gray-mapped square QAM, soft demapping
    mutual_information  bits that a QAM symbol carries
    ldpc                LDPC encoder and decoder
    ldpc_graph          the codes of 5G NR
"""
