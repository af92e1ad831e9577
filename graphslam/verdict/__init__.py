"""Whether a result can be trusted: evidence, doubts by subject, and the verdict of them all."""
