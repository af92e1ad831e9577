"""From a log to a `Result`: `smooth.smooth` is the main job, `pipeline` one pass over a log."""
