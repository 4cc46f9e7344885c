"""Pose-invariant 3D reconstruction from single images (Peng et al. 2020) with the renderer `nmr`."""
