"""German. Words as Blender's own German has them, else as compositors say them: Plate, Take, Shot, Compositor, Matte.

frame: Bild; solve: Kameralösung; bake: backen; run: Lauf; t*: der Zeitpunkt, in Bildern des Clips; freeze (the thing):
Freeze; guesses: Geratenes; support: Stützung. Nobody is addressed: infinitives.
"""

MESSAGES: dict[str, str] = {
    # ------------------------------------------------------------------------------------------ panel: the steps
    "1  Footage": "1  Material",
    "2  Camera": "2  Kamera",
    "3  Train": "3  Training",
    "4  Freeze": "4  Einfrieren",
    "5  Bake": "5  Backen",
    "Step 1: footage into a shot folder": "Schritt 1: Material in einen Shot-Ordner",
    "Step 2: the camera": "Schritt 2: die Kamera",
    "Step 3: training": "Schritt 3: das Training",
    "Step 4: the freeze": "Schritt 4: der Freeze",
    "Step 5: bake": "Schritt 5: Backen",
    "Footage": "Material",
    "Camera": "Kamera",
    "Train": "Trainieren",
    "Freeze": "Einfrieren",
    "Bake": "Backen",
    "Import Clip": "Clip importieren",
    "Import Again": "Neu importieren",
    "Solve Camera": "Kamera lösen",
    "Solve Again": "Neu lösen",
    "Train On": "Weitertrainieren",
    "Freeze Again": "Neu einfrieren",
    "Bake and Render": "Backen und rendern",
    "Bake Again": "Neu backen",
    "Import the clip first.": "Zuerst den Clip importieren.",
    "Solve the camera first.": "Zuerst die Kamera lösen.",
    "Train first.": "Zuerst trainieren.",
    "Freeze first.": "Zuerst einfrieren.",
    "Bake first.": "Zuerst backen.",
    "Choose a clip of people holding still.": "Einen Clip wählen, in dem Menschen stillhalten.",
    "Import the clip.": "Den Clip importieren.",
    "{} frames, {} to {}": "{} Bilder, {} bis {}",
    "{} x {}, {} fps": "{} x {}, {} Bilder/s",
    "Next: solve the camera.": "Als Nächstes: die Kamera lösen.",
    "Find where the camera was on every frame.": "Herausfinden, wo die Kamera in jedem Bild war.",
    "The solve is not in this scene: load it.": "Die Kameralösung ist nicht in dieser Szene: laden.",
    "Look through the camera, then train.": "Durch die Kamera schauen, dann trainieren.",
    "Learn the scene and what moves in it.": "Die Szene lernen und was sich darin bewegt.",
    "{} dB on frames kept out": "{} dB auf zurückgehaltenen Bildern",
    "no frames kept out": "keine Bilder zurückgehalten",
    "{} Gaussians, {} % move": "{} Gaussians, {} % bewegt",
    "Run {}: {}": "Lauf {}: {!t}",
    "Next: freeze an instant.": "Als Nächstes: einen Zeitpunkt einfrieren.",
    "Render the clip's move with time standing still.": "Die Fahrt des Clips bei stehender Zeit rendern.",
    "Take {}: {} frames, {} x {}": "Take {}: {} Bilder, {} x {}",
    "Time stands still at frame {}": "Die Zeit steht bei Bild {} still",
    "Next: bake it into your compositor.": "Als Nächstes: in den Compositor backen.",
    "Put the freeze before your compositor's output and render.": "Den Freeze vor die Ausgabe des Compositors setzen "
    "und rendern.",
    "The freeze is in your compositor.": "Der Freeze ist im Compositor.",
    "The view transform {} changes the plate's colours.": "Die Anzeigetransformation {} verändert die Farben der "
    "Plate.",
    "Frames go to {}": "Bilder gehen nach {}",
    # ------------------------------------------------------------------------------------------ panel: at work
    "Advanced": "Erweitert",
    "Progress": "Fortschritt",
    "Starting": "Startet",
    "{} {} %": "{!t} {} %",
    "Cancel": "Abbrechen",
    "The backend is starting.": "Das Backend startet.",
    "about {} left": "noch etwa {}",
    "{} s": "{} s",
    "{} min": "{} min",
    "Rendering, frame {} of {}": "Rendert Bild {} von {}",
    "Press Esc in the render window to stop.": "Esc im Render-Fenster hält an.",
    "Reading the camera, frame {} of {}": "Liest die Kamera, Bild {} von {}",
    "Open Log": "Protokoll öffnen",
    "Cancelled. Finished work is kept: start it again to go on.": "Abgebrochen. Fertiges bleibt: ein neuer Start geht "
    "dort weiter.",
    "The backend is not set up: choose its Python in the add-on's preferences.": "Das Backend ist nicht eingerichtet: "
    "in den Einstellungen des Add-ons sein Python wählen.",
    "{} to {} dB on frames kept out, in {}": "{} bis {} dB auf zurückgehaltenen Bildern, in {}",
    "Range": "Bereich",
    "Folder": "Ordner",
    "Frame t*": "Bild t*",
    "Scrub in View": "In der Ansicht scrubben",
    "Stop Scrubbing": "Scrubben beenden",
    "Frozen frames are sharp throughout: the camera's depth of field is not in them.": "Eingefrorene Bilder sind "
    "durchweg scharf: die Schärfentiefe der Kamera ist nicht darin.",
    "Insert in Compositor Only": "Nur in den Compositor setzen",
    "The console has the details.": "Näheres steht in der Konsole.",
    "The backend is loading the run.": "Das Backend lädt den Lauf.",
    "Suggestion {}: frame {} saw {} % of what moves, as sharp as {} %.": "Vorschlag {}: Bild {} sah {} % dessen, was "
    "sich bewegt, und ist so scharf wie {} %.",
    "Shown: frame {}.": "Gezeigt: Bild {}.",
    "Suggested: {}.": "Vorgeschlagen: {}.",
    "{} of {} frames rendered.": "{} von {} Bildern gerendert.",
    "{} dB, {} Gaussians": "{} dB, {} Gaussians",
    "t* {}, run {}": "t* {}, Lauf {}",
    # ------------------------------------------------------------------------------------------ buttons
    "Freeze time in a handheld clip of people holding still": "In einem handgehaltenen Clip mit stillhaltenden Menschen "
    "die Zeit anhalten",
    "Take the clip's frames into the shot folder and check them": "Die Bilder des Clips in den Shot-Ordner übernehmen "
    "und prüfen",
    "Find where the camera was on every frame, and bring it in as an animated camera with the plate behind it": "Heraus"
    "finden, wo die Kamera in jedem Bild war, und sie als animierte Kamera mit der Plate dahinter hereinholen",
    "Learn the scene and what moves in it from the clip": "Die Szene und was sich darin bewegt aus dem Clip lernen",
    "Render time standing still at t*: from every pose of the clip, or from an animated camera of your own": "Die bei "
    "t* stehende Zeit rendern: aus jeder Kameraposition des Clips oder aus einer eigenen animierten Kamera",
    "Render frames that are missing or stale, put the freeze before the output of the scene's compositor, and render "
    "the scene's range to its output path": "Fehlende oder veraltete Bilder rendern, den Freeze vor die Ausgabe des "
    "Compositors der Szene setzen und den Bildbereich der Szene in ihren Ausgabepfad rendern",
    "Render Baked Shot": "Gebackenen Shot rendern",
    "Render the scene's range through the compositor to its output path": "Den Bildbereich der Szene durch den "
    "Compositor in ihren Ausgabepfad rendern",
    "Load Camera": "Kamera laden",
    "Bring the solved camera, its plate and the points into this scene, in place of an earlier solve of this shot": "Die "
    "gelöste Kamera, ihre Plate und die Punkte in diese Szene holen, anstelle einer früheren Lösung dieses Shots",
    "Insert Freeze in Compositor": "Freeze in den Compositor setzen",
    "Put the frozen take before the output of the scene's compositor, or update it, without rendering": "Den "
    "eingefrorenen Take vor die Ausgabe des Compositors der Szene setzen oder ihn aktualisieren, ohne zu rendern",
    "Combine with Scene's Objects": "Mit Objekten der Szene kombinieren",
    "Lead the scene's own render into the freeze, so that your objects stand in front of and behind the frozen people "
    "by depth. Sets the film transparent and the depth pass on": "Das eigene Rendering der Szene in den Freeze leiten, "
    "sodass Objekte der Tiefe nach vor und hinter den eingefrorenen Menschen stehen. Stellt den Film auf transparent "
    "und schaltet den Tiefen-Pass ein",
    "Remove Shot from Scene": "Shot aus der Szene entfernen",
    "Take camera, points and the compositor group of this shot out of the file, and give the scene its own settings "
    "back. The shot folder on disk stays": "Kamera, Punkte und Compositor-Gruppe dieses Shots aus der Datei nehmen und "
    "der Szene ihre eigenen Einstellungen zurückgeben. Der Shot-Ordner auf der Platte bleibt",
    "Set t* from Current Frame": "t* vom aktuellen Bild nehmen",
    "Let time stand still at the current frame": "Die Zeit beim aktuellen Bild stehen lassen",
    "Marker for t*": "Marker für t*",
    "Show t* as a marker on the timeline, to be dragged; press again to take it away": "t* als ziehbaren Marker auf der "
    "Zeitleiste zeigen; erneut drücken nimmt ihn weg",
    "Draw the frozen instant over the 3D view while you scrub t* and move the view; press again to stop": "Den "
    "eingefrorenen Zeitpunkt über die 3D-Ansicht zeichnen, während t* gescrubbt und die Ansicht bewegt wird; erneut "
    "drücken beendet es",
    "Suggested Instant": "Vorgeschlagener Zeitpunkt",
    "Set t* to the previous or next suggested instant: one that saw most of what moves, and whose plate is sharp": "t* "
    "auf den vorigen oder nächsten vorgeschlagenen Zeitpunkt setzen: einen, der das meiste Bewegte sah und dessen Plate "
    "scharf ist",
    "Step": "Schritt",
    "1: the next one, -1: the one before": "1: der nächste, -1: der vorige",
    "Use as Splannequin Clip": "Als Splannequin-Clip nehmen",
    "Splannequin Clip": "Splannequin-Clip",
    "Make this video the clip of the scene's shot; nothing is imported yet": "Dieses Video zum Clip des Shots der Szene "
    "machen; importiert wird noch nichts",
    "File": "Datei",
    "Video to be used": "Video, das genommen wird",
    "Movies Only": "Nur Videos",
    "Show videos only": "Nur Videos zeigen",
    "Folders": "Ordner",
    "Show folders": "Ordner zeigen",
    "Use This Clip": "Diesen Clip nehmen",
    "Make the clip that this editor shows the clip of the scene's shot": "Den Clip, den dieser Editor zeigt, zum Clip "
    "des Shots der Szene machen",
    "The clip of this editor for a frozen shot": "Der Clip dieses Editors für einen eingefrorenen Shot",
    "Then see the 3D view's sidebar.": "Weiter in der Seitenleiste der 3D-Ansicht.",
    "Cancel Step": "Schritt abbrechen",
    "Stop this step. It saves what it has first; pressed again after 20 seconds, it is ended by force": "Diesen Schritt "
    "anhalten. Er sichert zuerst, was er hat; nach 20 Sekunden erneut gedrückt, wird er gewaltsam beendet",
    "Name of the step to cancel; empty: the one that runs": "Name des Schritts, der abgebrochen wird; leer: der laufende",
    "Open the log of this step in the system's viewer": "Das Protokoll dieses Schritts im Betrachter des Systems öffnen",
    "Name of the step": "Name des Schritts",
    # ------------------------------------------------------------------------------------------ settings
    "Clip": "Clip",
    "Video file, or one image of a numbered sequence, of people holding still": "Videodatei oder ein Bild einer "
    "nummerierten Sequenz, in der Menschen stillhalten",
    "Shot Folder": "Shot-Ordner",
    "Folder that keeps everything of this shot; empty: made beside the clip": "Ordner, der alles zu diesem Shot enthält; "
    "leer: wird neben dem Clip angelegt",
    "Only a Range": "Nur einen Bereich",
    "Import a part of the clip instead of all of it": "Einen Teil des Clips importieren statt des ganzen",
    "First": "Erstes",
    "First frame number of the clip to import": "Nummer des ersten Bildes, das importiert wird",
    "Last": "Letztes",
    "Last frame number to import, inclusive": "Nummer des letzten Bildes, das importiert wird, einschließlich",
    "Lens": "Objektiv",
    "How the lens bends straight lines": "Wie das Objektiv gerade Linien verbiegt",
    "Ordinary": "Gewöhnlich",
    "One coefficient: phones, most cameras": "Ein Koeffizient: Telefone, die meisten Kameras",
    "Strong": "Stark",
    "Four coefficients: action cameras, very wide lenses": "Vier Koeffizienten: Actionkameras, starke Weitwinkel",
    "Preset": "Vorgabe",
    "How much to spend on training": "Wie viel Aufwand das Training treibt",
    "Preview": "Vorschau",
    "Small and quick: to see whether the shot holds, minutes on a laptop": "Klein und schnell: um zu sehen, ob der Shot "
    "trägt, Minuten auf einem Laptop",
    "Standard": "Standard",
    "For most shots": "Für die meisten Shots",
    "Final": "Final",
    "Largest pictures and most Gaussians: takes longest": "Größte Bilder und die meisten Gaussians: dauert am längsten",
    "Run": "Lauf",
    "Name of the training run; a new name keeps the old": "Name des Trainingslaufs; ein neuer Name lässt den alten "
    "bestehen",
    "Choose the Instant": "Zeitpunkt selbst wählen",
    "Set the frame at which time stands still yourself; off: the best supported one is taken": "Das Bild, bei dem die "
    "Zeit stillsteht, selbst bestimmen; aus: das am besten gestützte wird genommen",
    "Frame number of the clip at which time stands still. Keyed, it is followed frame by frame: freeze, hold and "
    "release": "Bildnummer des Clips, bei der die Zeit stillsteht. Mit Schlüsselbildern wird ihr Bild für Bild gefolgt: "
    "einfrieren, halten, lösen",
    "Animated camera to see the frozen instant from; empty: the clip's own move": "Animierte Kamera, aus der der "
    "eingefrorene Zeitpunkt gesehen wird; leer: die Fahrt des Clips",
    "Width": "Breite",
    "Width in pixels of the frozen frames; 0: as trained, or as the scene renders from a camera of your own": "Breite "
    "der eingefrorenen Bilder in Pixeln; 0: wie trainiert oder, bei eigener Kamera, wie die Szene rendert",
    "Show": "Zeigen",
    "What is drawn over the view while scrubbing": "Was beim Scrubben über die Ansicht gezeichnet wird",
    "Picture": "Bild",
    "The frozen people and place": "Die eingefrorenen Menschen und der Ort",
    "Guesses": "Geratenes",
    "The picture, tinted where no frame near t* saw what is shown": "Das Bild, getönt, wo kein Bild nahe t* das "
    "Gezeigte sah",
    "Support": "Stützung",
    "White where frames near t* saw what is shown, black where it is a guess": "Weiß, wo Bilder nahe t* das Gezeigte "
    "sahen, schwarz, wo es geraten ist",
    "Motion": "Bewegung",
    "White where something moves in the clip": "Weiß, wo sich im Clip etwas bewegt",
    "Take": "Take",
    "Name of the frozen frames; a new name keeps the old": "Name der eingefrorenen Bilder; ein neuer Name lässt die "
    "alten bestehen",
    "Fit Scene to Clip": "Szene an Clip anpassen",
    "Set resolution, frame rate and frame range of the scene to the clip's. Off: only a new scene is set up, one you "
    "have worked in is left alone": "Auflösung, Bildrate und Bildbereich der Szene auf die des Clips setzen. Aus: nur "
    "eine neue Szene wird eingerichtet, eine bearbeitete bleibt, wie sie ist",
    "Keep Plate Colours": "Farben der Plate erhalten",
    "Set the view transform to Standard and dither to 0, so that pictures leave with the colours they came in with. "
    "Blender's default view changes them": "Die Anzeigetransformation auf Standard und Dither auf 0 setzen, damit "
    "Bilder mit den Farben hinausgehen, mit denen sie kamen. Blenders Voreinstellung verändert sie",
    # ------------------------------------------------------------------------------------------ messages
    "A step of this shot is running": "Ein Schritt dieses Shots läuft",
    "Train first": "Zuerst trainieren",
    "There is no 3D view": "Es gibt keine 3D-Ansicht",
    "Suggestions come with Scrub in View": "Vorschläge kommen mit „In der Ansicht scrubben“",
    "Cancelled: finished work is kept": "Abgebrochen: Fertiges bleibt erhalten",
    "No shot is chosen: import a clip first": "Kein Shot gewählt: zuerst einen Clip importieren",
    "Blender did not render the scene: {}": "Blender hat die Szene nicht gerendert: {}",
    "No file was given": "Keine Datei angegeben",
    "Clip chosen: press Import Clip in the Splannequin tab": "Clip gewählt: im Reiter Splannequin „Clip importieren“ "
    "drücken",
    "Nothing is running": "Es läuft nichts",
    "There is no log": "Es gibt kein Protokoll",
    "Resolution set to {} x {}.": "Auflösung auf {} x {} gesetzt.",
    "Pixel aspect set to the lens's.": "Pixelaspekt auf den des Objektivs gesetzt.",
    "Frame rate set to {}.": "Bildrate auf {} gesetzt.",
    "Frame range set to {} to {}.": "Bildbereich auf {} bis {} gesetzt.",
    "View transform set from {} to Standard, so that the plate keeps its colours.": "Anzeigetransformation von {} auf "
    "Standard gesetzt, damit die Plate ihre Farben behält.",
    "Dither set to 0, so that pixels stay exact.": "Dither auf 0 gesetzt, damit Pixel genau bleiben.",
    "Film set to transparent.": "Film auf transparent gesetzt.",
    "The depth pass was switched on.": "Der Tiefen-Pass wurde eingeschaltet.",
    "Output path set to {}.": "Ausgabepfad auf {} gesetzt.",
    "The scene's own render was led into the freeze: objects stand among the frozen people by depth.": "Das eigene "
    "Rendering der Szene wurde in den Freeze geleitet: Objekte stehen der Tiefe nach zwischen den eingefrorenen "
    "Menschen.",
    "The scene had no compositor tree: a minimal one was made.": "Die Szene hatte keinen Compositor-Baum: ein kleinster "
    "wurde angelegt.",
    "The compositor was switched on.": "Der Compositor wurde eingeschaltet.",
    'The node group "{}" was inserted before the output.': "Die Knotengruppe „{}“ wurde vor die Ausgabe gesetzt.",
    'The node group "{}" was updated.': "Die Knotengruppe „{}“ wurde aktualisiert.",
    "{} is the scene's camera, with the plate behind it.": "{} ist die Kamera der Szene, mit der Plate dahinter.",
    "The freeze left the compositor.": "Der Freeze ist aus dem Compositor genommen.",
    "Camera and points were removed.": "Kamera und Punkte wurden entfernt.",
    "The marker t* was removed.": "Der Marker t* wurde entfernt.",
    "The scene's settings are as they were.": "Die Einstellungen der Szene sind wie zuvor.",
    "Your scene's size and range were left alone (Fit Scene to Clip is off).": "Größe und Bildbereich der Szene blieben, "
    "wie sie sind („Szene an Clip anpassen“ ist aus).",
    "Splannequin {}": "Splannequin: {!t}",
    # ------------------------------------------------------------------------------------------ errors
    "No clip is chosen.": "Kein Clip gewählt.",
    "Choose a video or image sequence.": "Ein Video oder eine Bildsequenz wählen.",
    "No shot is chosen.": "Kein Shot gewählt.",
    "Import a clip or choose a shot folder.": "Einen Clip importieren oder einen Shot-Ordner wählen.",
    "A step of {} is still running.": "Ein Schritt von {} läuft noch.",
    "Wait for it or cancel it.": "Abwarten oder abbrechen.",
    "Cannot write to {}: {}.": "In {} kann nicht geschrieben werden: {}.",
    "Choose another shot folder.": "Einen anderen Shot-Ordner wählen.",
    "{} is no shot folder.": "{} ist kein Shot-Ordner.",
    "The take {} of {} holds no frozen frames.": "Der Take {} von {} enthält keine eingefrorenen Bilder.",
    "Blender could not render the scene: {}": "Blender konnte die Szene nicht rendern: {}",
    "Open shot.blend and render it there to see why.": "shot.blend öffnen und dort rendern, um den Grund zu sehen.",
    "Blender wrote no picture for frame {} in {}.": "Blender hat für Bild {} nichts in {} geschrieben.",
    "Is the disk full, or the folder not yours to write?": "Ist die Platte voll, oder fehlt das Schreibrecht?",
    "{} is not a perspective camera of this scene.": "{} ist keine perspektivische Kamera dieser Szene.",
    "Choose another camera to freeze from.": "Eine andere Kamera zum Einfrieren wählen.",
    "The freeze is not in this compositor.": "Der Freeze ist nicht in diesem Compositor.",
    'Something is led into "CG" of {} already.': "In „CG“ von {} führt schon etwas.",
    "Unlink it to have it done here.": "Die Verbindung lösen, damit es hier geschieht.",
    "This Blender's colour configuration has no {} {}.": "Die Farbkonfiguration dieses Blenders kennt {} {} nicht.",
    "Use Blender's own configuration, or switch Keep Plate Colours off.": "Blenders eigene Konfiguration nehmen oder "
    "„Farben der Plate erhalten“ ausschalten.",
    "There is no view to draw in.": "Es gibt keine Ansicht, in die gezeichnet werden kann.",
    "Use Freeze.": "„Einfrieren“ nehmen.",
    "There is no trained run {}.": "Es gibt keinen trainierten Lauf {}.",
    "The shot folder cannot be read: {}": "Der Shot-Ordner kann nicht gelesen werden: {}",
    "The job in {} cannot be read: {}": "Der Auftrag in {} kann nicht gelesen werden: {}",
    "The live session broke: {}.": "Die Live-Sitzung ist abgerissen: {}.",
    "The live session could not be started: {}.": "Die Live-Sitzung konnte nicht gestartet werden: {}.",
    "Check the backend's Python in the add-on's preferences.": "In den Einstellungen des Add-ons das Python des Backends "
    "prüfen.",
    "Start it again.": "Noch einmal starten.",
    "Start it again. Its log is {}.": "Noch einmal starten. Das Protokoll ist {}.",
    "The backend stopped without a word during {}{}.": "Das Backend hat ohne ein Wort aufgehört, bei: {!t}{}.",
    "It was killed, perhaps for want of memory: close other programs or choose a smaller preset, then start again.": "Es "
    "wurde beendet, vielleicht weil der Speicher nicht reichte: andere Programme schließen oder eine kleinere Vorgabe "
    "wählen, dann neu starten.",
    "Start it again: finished work is kept. Its whole log is {}": "Noch einmal starten: Fertiges bleibt. Das ganze "
    "Protokoll ist {}",
    # ------------------------------------------------------------------------------------------ preferences
    "In use: {}": "In Gebrauch: {}",
    "Folder (empty: {})": "Ordner (leer: {})",
    "Backend Python": "Python des Backends",
    "Python interpreter of a backend environment that is there already; empty: found by itself": "Python-Interpreter "
    "einer schon vorhandenen Backend-Umgebung; leer: wird selbst gefunden",
    "Where Set Up Backend puts the environment; empty: a short path in your home folder": "Wohin „Backend einrichten“ "
    "die Umgebung legt; leer: ein kurzer Pfad im persönlichen Ordner",
    "Device": "Gerät",
    "Where the backend trains and freezes": "Worauf das Backend trainiert und einfriert",
    "Automatic": "Automatisch",
    "The NVIDIA card if there is one that can be used, else the processor": "Die NVIDIA-Karte, wenn eine brauchbare da "
    "ist, sonst der Prozessor",
    "Processor": "Prozessor",
    "Always the processor": "Immer der Prozessor",
    "NVIDIA Card": "NVIDIA-Karte",
    "Only the NVIDIA card: without one, jobs end with a sentence": "Nur die NVIDIA-Karte: ohne sie enden Aufträge mit "
    "einem Satz",
    "Set Up Backend": "Backend einrichten",
    "Repair": "Reparieren",
    "Check Backend": "Backend prüfen",
    "Remove Backend": "Backend entfernen",
    "Download and install what the backend needs, into an environment of its own": "Herunterladen und installieren, was "
    "das Backend braucht, in eine eigene Umgebung",
    "Stop the set-up; it goes on from there when it is started again": "Das Einrichten anhalten; neu gestartet, geht es "
    "von dort weiter",
    "Start the backend once and say what it can do on this machine": "Das Backend einmal starten und sagen, was es auf "
    "dieser Maschine kann",
    "Delete the environment that Set Up Backend made. Shots and their runs stay": "Die Umgebung löschen, die „Backend "
    "einrichten“ angelegt hat. Shots und ihre Läufe bleiben",
    "Download and Install": "Herunterladen und installieren",
    "Into {}: {}.": "Nach {}: {!t}.",
    "It installs {}.": "Installiert wird {!t}.",
    "Installs {}.": "Installiert wird {!t}.",
    "Makes a Python environment of its own: {}.": "Legt eine eigene Python-Umgebung an: {!t}.",
    "about 1.5 GB on disk (6 GB with CUDA), downloaded from PyPI": "etwa 1,5 GB auf der Platte (6 GB mit CUDA), von PyPI "
    "heruntergeladen",
    "PyTorch (BSD), COLMAP (BSD), OpenImageIO (Apache), PyAV (LGPL), Warp (Apache) and what they need": "PyTorch (BSD), "
    "COLMAP (BSD), OpenImageIO (Apache), PyAV (LGPL), Warp (Apache) und was sie brauchen",
    "Nothing is changed in Blender's own Python.": "An Blenders eigenem Python wird nichts geändert.",
    "Blender may not go online: allow it in Preferences > System > Network": "Blender darf nicht online gehen: erlauben "
    "unter Einstellungen > System > Network",
    "Blender may not go online: allow it in Preferences > System > Network.": "Blender darf nicht online gehen: erlauben "
    "unter Einstellungen > System > Network.",
    "Repair goes on where it stopped.": "„Reparieren“ geht dort weiter, wo es aufgehört hat.",
    "Checking the backend.": "Das Backend wird geprüft.",
    "The backend's environment was removed": "Die Umgebung des Backends wurde entfernt",
    "There was nothing to remove": "Es gab nichts zu entfernen",
    "The environment stays: {}": "Die Umgebung bleibt: {}",
    "Python {}, torch {}.": "Python {}, torch {}.",
    "Trains on {}.": "Trainiert auf {}.",
    "Trains on the processor, {} cores.": "Trainiert auf dem Prozessor, {} Kerne.",
    "The NVIDIA card is not used: {}": "Die NVIDIA-Karte wird nicht benutzt: {}",
    "The backend cannot be set up in {}: {}.": "Das Backend kann in {} nicht eingerichtet werden: {}.",
    "Choose another folder in the add-on's preferences.": "In den Einstellungen des Add-ons einen anderen Ordner wählen.",
    "The set-up ended with exit code {}: {}": "Das Einrichten endete mit Code {}: {}",
    "The backend's Python named in {} does not exist: {}.": "Das in {} genannte Python des Backends gibt es nicht: {}.",
    "Correct the path, or clear it to have the backend found by itself.": "Den Pfad berichtigen oder leeren, damit das "
    "Backend selbst gefunden wird.",
    "Splannequin's backend is not set up: no Python environment for it was found.": "Splannequins Backend ist nicht "
    "eingerichtet: es wurde keine Python-Umgebung dafür gefunden.",
    "Press Set Up Backend in the add-on's preferences, or choose the Python of one that is there (or name it in {}).": "In "
    "den Einstellungen des Add-ons „Backend einrichten“ drücken oder das Python eines vorhandenen wählen (oder es in {} "
    "nennen).",
    "The backend's environment is incomplete: {}.": "Die Umgebung des Backends ist unvollständig: {}.",
    "Press Repair in the add-on's preferences, or run `python3 splannequin.py setup` again.": "In den Einstellungen des "
    "Add-ons „Reparieren“ drücken oder `python3 splannequin.py setup` noch einmal ausführen.",
    "The backend did not answer: {}.": "Das Backend hat nicht geantwortet: {}.",
    "Set it up again.": "Neu einrichten.",
    "The backend's Python could not be started: {}: {}.": "Das Python des Backends konnte nicht gestartet werden: {}: {}.",
    "Choose the Python of the backend's environment in the add-on's preferences.": "In den Einstellungen des Add-ons das "
    "Python der Backend-Umgebung wählen.",
}

BACKEND: dict[str, str] = {
    # ------------------------------------------------------------------------------------------ stages and counts
    "Import": "Import",
    "Solve": "Kameralösung",
    "Solve: {}": "Kameralösung: {!t}",
    "Solve: undistort": "Kameralösung: entzerren",
    "features": "Merkmale",
    "other features": "weitere Merkmale",
    "matches": "Zuordnung",
    "other matches": "weitere Zuordnung",
    "cameras": "Kameras",
    "Loading frames": "Bilder laden",
    "Training": "Training",
    "Freezing": "Einfrieren",
    "Finishing the take": "Take abschließen",
    "already imported": "schon importiert",
    "already solved": "schon gelöst",
    "already trained": "schon trainiert",
    "frame {}": "Bild {}",
    "{} frames": "{} Bilder",
    "{} of {}": "{} von {}",
    "step {}, {} Gaussians, loss {}": "Schritt {}, {} Gaussians, Fehler {}",
    "resumed at step {}": "fortgesetzt bei Schritt {}",
    "contact sheet": "Kontaktbogen",
    "video": "Video",
    # ------------------------------------------------------------------------------------------ footage
    "No footage was given.": "Kein Material angegeben.",
    "Choose a video file, a picture of a numbered sequence, or a folder.": "Eine Videodatei, ein Bild einer nummerierten "
    "Sequenz oder einen Ordner wählen.",
    "The footage {} does not exist.": "Das Material {} gibt es nicht.",
    "Check the path; a clip on a server must be mounted.": "Den Pfad prüfen; ein Clip auf einem Server muss eingebunden "
    "sein.",
    "{} is not a video that can be read.": "{} ist kein lesbares Video.",
    "Choose a video file (MP4, MOV, MKV) or a numbered image sequence.": "Eine Videodatei (MP4, MOV, MKV) oder eine "
    "nummerierte Bildsequenz wählen.",
    "{} is a single picture, not part of a numbered sequence.": "{} ist ein einzelnes Bild, kein Teil einer nummerierten "
    "Sequenz.",
    "A freeze needs a clip: choose a video or a sequence.": "Ein Freeze braucht einen Clip: ein Video oder eine Sequenz "
    "wählen.",
    "The clip has only {} frames: a freeze needs at least {}.": "Der Clip hat nur {} Bilder: ein Freeze braucht "
    "mindestens {}.",
    "Choose a longer clip or range.": "Einen längeren Clip oder Bereich wählen.",
    "Frames {} to {} are too few: a freeze needs at least {}.": "Die Bilder {} bis {} sind zu wenige: ein Freeze braucht "
    "mindestens {}.",
    "Widen the range.": "Den Bereich erweitern.",
    "Frames {} to {} lie outside of the clip, which has {} to {}.": "Die Bilder {} bis {} liegen außerhalb des Clips, "
    "der {} bis {} hat.",
    "The picture does not change in {} of {} frames: the camera stands still.": "In {} von {} Bildern ändert sich nichts: "
    "die Kamera steht still.",
    "A freeze needs a clip in which the camera moves sideways by a step or more.": "Ein Freeze braucht einen Clip, in dem "
    "sich die Kamera um einen Schritt oder mehr seitwärts bewegt.",
    "The clip has a hard cut at frame {}: a freeze needs one continuous take.": "Der Clip hat bei Bild {} einen harten "
    "Schnitt: ein Freeze braucht eine durchgehende Einstellung.",
    "The clip is {} pixels high: the working frames stay that high.": "Der Clip ist {} Pixel hoch: die Arbeitsbilder "
    "bleiben so hoch.",
    # ------------------------------------------------------------------------------------------ camera
    "{}: {} of {} frames registered, {} px.": "{!t}: {} von {} Bildern gelöst, {} px.",
    "Good": "Gut",
    "Fair": "Brauchbar",
    "Poor": "Schwach",
    "No two frames show enough of the same scene from different places to start a camera solve.": "Keine zwei Bilder "
    "zeigen genug von derselben Szene von verschiedenen Orten, um die Kamera zu lösen.",
    "Cameras were found for only {} of {} frames{}.": "Nur für {} von {} Bildern wurden Kameras gefunden{}.",
    "Choose a range without fast pans or blur, or a smaller step.": "Einen Bereich ohne schnelle Schwenks und Unschärfe "
    "wählen oder eine kleinere Schrittweite.",
    "The camera hardly moves in this clip, so depth cannot be told.": "Die Kamera bewegt sich in diesem Clip kaum, daher "
    "ist die Tiefe nicht zu erkennen.",
    "Use footage in which the camera travels.": "Material nehmen, in dem die Kamera fährt.",
    "Their cameras are placed from their neighbours.": "Ihre Kameras sind aus den Nachbarn ergänzt.",
    # ------------------------------------------------------------------------------------------ training and freeze
    "Too much motion: {} % of the Gaussians had to move.": "Zu viel Bewegung: {} % der Gaussians mussten sich bewegen.",
    "Expect ghosts where people walked; a range in which they hold still does better.": "Wo Menschen gehen, sind Geister "
    "zu erwarten; ein Bereich, in dem sie stillhalten, wird besser.",
    "The run's settings or cameras changed: it is trained anew.": "Einstellungen oder Kameras des Laufs haben sich "
    "geändert: er wird neu trainiert.",
    "Frame {} was not trained on: time stands still at frame {}, the nearest that was.": "Auf Bild {} wurde nicht "
    "trainiert: die Zeit steht bei Bild {}, dem nächsten, auf das trainiert wurde.",
    "t* is frame {}, the shot has frames {} to {}.": "t* ist Bild {}, der Shot hat die Bilder {} bis {}.",
    "Choose a frame of the shot.": "Ein Bild des Shots wählen.",
    "No space left in {}: {}.": "Kein Platz mehr in {}: {}.",
    "Free some space or choose another output folder, then start again: finished work is kept.": "Platz schaffen oder "
    "einen anderen Ausgabeordner wählen, dann neu starten: Fertiges bleibt.",
}
"""The commonest of what the backend says; the rest of its sentences stay English."""

MESSAGES |= BACKEND
