"""Estimators: measurements in, pose and covariance out."""
