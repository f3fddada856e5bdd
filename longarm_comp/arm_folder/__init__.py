"""An arm's folder: arm.yaml and the servo, camera and marker files that fit it."""
