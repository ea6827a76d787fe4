"""The steps of SIFT, as tensor ops and as compiled loops: scale space, keypoints, descriptors, matching."""
