"""What is built on runs: rollouts, accuracy, checks of gradients."""
