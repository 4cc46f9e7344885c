"""From a prediction to what a picture shows: its mask, camera, shape and colours."""
