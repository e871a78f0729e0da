"""The integrity of a closed loop: watermark, attack on the measurements, and detector."""
