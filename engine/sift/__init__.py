"""The steps of SIFT as tensor ops: scale space, keypoints, descriptors."""
