"""Faults of every kind, one after another, at random: what becomes of tracking, and what is left behind.

The figures, which programs may rely on:
  seed, events       of the dice, and how many were asked for
  happened, failed   events that were brought about, and those of which something was not as it must be
  rows               of each event, in order: run (number), kind, process, away_s (until its cause was gone, by itself
                     or because the process was replaced), back_s (from there until half a second was tracked),
                     frames_without_pose (from the event until then), problems (in words)
  kinds              "kind process" -> events, failed, away_s and back_s (p50 and max)
  wrong              poses that were said to be TRACKING beyond 2 degrees or 0.05 units: run, frame_id,
                     rotation_error_deg, translation_error, carried (it was not measured)
  frames             of all runs
  problems           what runs left behind, each with the number of its run
  skipped            kind -> why this machine cannot do it
"""
