"""A robot on the spherical shell of another: its angles, the shell's markers, poses from them."""
