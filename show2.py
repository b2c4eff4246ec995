import sys; sys.path.insert(0,'/tmp/h14mattes')
from off3 import *
rows=[]
for f,d in off.DATA:
    n=f.split('/')[-1]
    if n not in ('000_012.npz','000_024.npz','001_024.npz','001_036.npz','002_030.npz','002_045.npz'): continue
    s=comb(d,'mean')
    c=lambda v,m: np.repeat(np.clip(v/m*255,0,255).astype(np.uint8)[...,None],3,-1)
    imgs=[c(d['pic'],255),c(d['D'],4),c(s,2),c(d['inv'],np.percentile(d['inv'],98)),c(d['inv2'],np.percentile(d['inv'],98))]
    for o in (-4,2): imgs.append(c(np.hypot(*d[f'm{o}'][:2])*d[f'm{o}'][3],3) if f'm{o}' in d else c(d['pic'],255))
    imgs=[cv2.resize(i,(256,144)) for i in imgs]; rows.append(np.concatenate(imgs,1))
cv2.imwrite('/tmp/h14mattes/show.png',np.concatenate(rows,0))
