"""A job for a render farm, as Open Job Description: what is to be done, what it will cost, the template.

    shots       shots and clips, and the takes that are wanted of them
    work        tasks, and how much each has to do: pixels and steps
    template    the job template and its parameters, as JSON
    request     what a task is asked for, as it comes out of the template
    rates       what a unit of work takes, measured
    cost        core-hours, card-hours, disk and the critical path, of tasks and rates

What a task does on a computer of the farm is in `torch_backend/farm_task.py`.
"""
