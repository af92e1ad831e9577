"""One pass over a log, of any kind: messages in time order, keyframes, robots' states, steps."""
