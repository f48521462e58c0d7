# SPDX-License-Identifier: Apache-2.0
"""What a user should see before trusting a potential field: are there enough demonstrations, and do they agree?

Each episode is judged by the others alone. The field and the threshold of its safe set H are made without the episode, and
its actions are looked up in them. `examination.py` does that, and `verdict.py` sums it up in one sentence.
"""
