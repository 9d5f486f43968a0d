"""What has a reward."""
