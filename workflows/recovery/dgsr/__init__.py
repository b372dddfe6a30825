"""The paper's method: NN-DGSR with a Gaussian prior."""
