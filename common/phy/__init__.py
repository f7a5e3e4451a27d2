"""Physical layer shared by both radio ends: slots, pilots, 16-QAM, equaliser, LDPC."""
