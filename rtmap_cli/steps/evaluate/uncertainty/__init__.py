"""Are sigmas, covariances and probabilities honest?"""
