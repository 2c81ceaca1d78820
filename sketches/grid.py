import numpy as np, time, sys
from numba import njit
LAM,KAPPA,ALPHA,DELTA=9140.,4e4,1162.,3.1e-6
def kernel(a,var,x,width):
    dx=x[1]-x[0]; n=len(x); h=int(np.ceil(width*np.sqrt(var)/dx))+1
    # T[i,j]: density at x_i from x_j : rows gather. start index per row
    start=np.empty(n,np.int64); w=np.zeros((n,2*h+1))
    for i in range(n):
        c=int(np.round((x[i]/a-x[0])/dx)); s=c-h; start[i]=s
        for q in range(2*h+1):
            j=s+q
            if 0<=j<n: w[i,q]=np.exp(-(x[i]-a*x[j])**2/(2*var))/np.sqrt(2*np.pi*var)*dx
    return start,w
@njit(fastmath=True)
def apply(start,w,p,out):
    n=p.shape[0]; m=w.shape[1]
    for i in range(n):
        s=start[i]; acc=0.
        for q in range(max(0,-s),min(m,n-s)): acc+=w[i,q]*p[s+q]
        out[i]=acc
@njit(fastmath=True)
def applyT(start,w,p,out):
    n=p.shape[0]; m=w.shape[1]
    out[:]=0
    for i in range(n):
        s=start[i]
        for q in range(max(0,-s),min(m,n-s)): out[s+q]+=w[i,q]*p[i]
@njit(fastmath=True)
def run(x,start,w,dt,nu,a,sd,L,every,warm,samples,seed,Kf,af,cj):
    np.random.seed(seed); n=len(x)
    p=np.exp(-x**2/(2*.09)); p/=p.sum(); q=np.empty(n); b=np.empty(n); b2=np.empty(n)
    phist=np.zeros((L+1,n)); z=np.zeros(L+1); u=np.zeros(L+1); ph=np.zeros(L+1)
    xs=np.sin(x); xc=np.cos(x)
    phi=np.random.normal()*.3; xl=0.; inn=np.zeros(L+1); xlf=np.zeros(L+1)
    out=np.zeros((samples,4)); k=0; s=0
    total=warm+every*samples
    for step in range(1,total+1):
        r=step%(L+1)
        phi=a*phi+sd*np.random.normal()
        apply(start,w,p,q)
        m=0.
        t=0.
        for i in range(n): m+=q[i]*x[i]; t+=q[i]
        m/=t; cm=np.cos(m); sm=np.sin(m)
        g=nu/np.sqrt(dt)*np.random.normal()
        zz=np.sin(phi-m)+g
        tot=0.
        for i in range(n):
            e=zz-(xs[i]*cm-xc[i]*sm)
            p[i]=q[i]*np.exp(-.5*dt*e*e/(nu*nu)); tot+=p[i]
        mean=0.
        for i in range(n):
            p[i]/=tot; mean+=p[i]*x[i]
        phist[r]=p; z[r]=zz; u[r]=m; ph[r]=phi
        # linear
        xl=a*xl; v=phi+g-xl; inn[r]=v; xl+=Kf*v; xlf[r]=xl
        if step>warm and (step-warm)%every==0:
            b[:]=1.
            for j in range(L):
                rr=(step-j)%(L+1); cm=np.cos(u[rr]); sm=np.sin(u[rr]); top=0.
                for i in range(n):
                    e=z[rr]-(xs[i]*cm-xc[i]*sm)
                    b[i]*=np.exp(-.5*dt*e*e/(nu*nu)); top=max(top,b[i])
                for i in range(n): b[i]/=top
                applyT(start,w,b,b2)
                for i in range(n): b[i]=b2[i]
            rr=(step-L)%(L+1); num=0.; den=0.
            for i in range(n): c=phist[rr,i]*b[i]; num+=c*x[i]; den+=c
            ls=xlf[rr]
            for j in range(1,L+1): ls+=cj[j-1]*inn[(step-L+j)%(L+1)]
            out[s,0]=(num/den-ph[rr])**2; out[s,1]=(mean-phi)**2; out[s,2]=(ls-ph[rr])**2; out[s,3]=(xl-phi)**2; s+=1
    return out
def go(dt,dx,seconds,seed):
    L=int(round(DELTA/dt)); nu=1/(2*ALPHA); a=np.exp(-LAM*dt); var=KAPPA*(1-a*a)/(2*LAM)
    x=np.arange(-8,8+dx/2,dx); start,w=kernel(a,var,x,6.5)
    R=nu**2/dt; P=.1
    for _ in range(100000): Pp=a*a*P+var; K=Pp/(Pp+R); P=(1-K)*Pp
    Pp=a*a*P+var; S=Pp+R; K=Pp/S; af=a*(1-K)
    cj=np.array([P*a*(af)**(j-1)/S for j in range(1,L+1)]); Ps=P-np.sum(cj**2)*S
    t=time.time(); blocks=[]
    every=L
    while time.time()-t<seconds:
        o=run(x,start,w,dt,nu,a,np.sqrt(var),L,every,10*L,2000,seed,K,af,cj); seed+=1
        d=o.mean(0); blocks.append(d)
    B=np.array(blocks); ctrl=B[:,2:]-np.array([Ps,P])
    res=[]
    for c in (0,1):
        X=np.column_stack([np.ones(len(B)),ctrl]); coef,*_=np.linalg.lstsq(X,B[:,c],rcond=None); rres=B[:,c]-X@coef
        res.append((coef[0],rres.std(ddof=3)/np.sqrt(len(B)),B[:,c].mean(),B[:,c].std()/np.sqrt(len(B))))
    print(dt,dx,'lin',Ps,P,'seen',B[:,2:].mean(0),'smoothed',res[0],'filtered',res[1],'blocks',len(B),flush=True)
go(float(sys.argv[1]),float(sys.argv[2]),float(sys.argv[3]),int(sys.argv[4]))
