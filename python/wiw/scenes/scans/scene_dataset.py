ENDING = ".scene_instance.json"
read = find = None
