"""The marker chain: layout, boards, detector, projector, pose."""
