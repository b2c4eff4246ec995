"""A job for a render farm, as Open Job Description: its tasks, their cost, and the template.

    shots       shots and clips, and the takes to make of them
    work        tasks, and the amount of work of each: pixels and steps
    template    the job template and its parameters, as JSON
    request     the request that a task gets from the template
    rates       measured seconds per unit of work
    cost        core-hours, card-hours, disk and the critical path, from tasks and rates

What a task does on a computer of the farm is in `torch_backend/farm_task.py`.
"""
