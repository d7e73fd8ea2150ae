"""The paper's experiments, driven through the running graph and computed from the recorded bag."""
