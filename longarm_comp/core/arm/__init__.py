"""The declared arm, its file, rigid motions, posture and the record of circumstances."""
