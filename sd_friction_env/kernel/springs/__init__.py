"""Springs, one file each: restoring force R, normal force N and potential, with their derivatives."""
